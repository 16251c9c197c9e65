# SPDX-License-Identifier: Apache-2.0
"""The similarity transform between a capture's units and the normalised units of a scene.

Learning rates and voxel sizes are defined for scenes of one size (paper, section Implementations), so training runs in
normalised units. The stream header stores the transform.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from structgstream.cameras import Camera, CameraRig


@dataclass(frozen=True)
class Similarity:
    """``normalised = (world - center) * scale``, without rotation."""

    center: tuple[float, float, float] = (0.0, 0.0, 0.0)
    scale: float = 1.0

    def points(self, points: Tensor) -> Tensor:
        """World points ``[..., 3]`` to normalised ones."""
        return (points - torch.tensor(self.center, dtype=points.dtype)) * self.scale

    def inverse_points(self, points: Tensor) -> Tensor:
        """Normalised points ``[..., 3]`` back to the capture's own units."""
        return points / self.scale + torch.tensor(self.center, dtype=points.dtype)

    def camera(self, camera: Camera) -> Camera:
        """A camera of the capture in normalised units; it shows the same picture."""
        viewmat = camera.viewmat.clone()
        center = torch.tensor(self.center, dtype=torch.float64)
        viewmat[:3, 3] = (camera.viewmat[:3, :3] @ center + camera.viewmat[:3, 3]) * self.scale
        return replace(camera, viewmat=viewmat, near=camera.near * self.scale)

    def rig(self, rig: CameraRig) -> CameraRig:
        """Every camera of ``rig`` through :meth:`camera`."""
        return rig.mapped({name: self.camera(rig[name]) for name in rig})


def rig_radius(rig: CameraRig) -> float:
    """Largest distance of a training camera to the mean training-camera position, in the capture's units."""
    centers = torch.stack([rig[name].center for name in rig.training])
    return float((centers - centers.mean(0)).norm(dim=1).max())


def normalizing_similarity(rig: CameraRig, *, radius: float) -> Similarity:
    """The similarity that moves the training cameras' mean to the origin and makes the rig's radius ``radius``."""
    centers = torch.stack([rig[name].center for name in rig.training])
    center = centers.mean(0)
    return Similarity(center=(float(center[0]), float(center[1]), float(center[2])), scale=radius / rig_radius(rig))

# SPDX-License-Identifier: Apache-2.0
"""The similarity transform between two estimates of one rig."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch

from structgstream.cameras import Camera
from structgstream.data.arrays import Floats
from structgstream.data.lenses import LensCamera


@dataclass(frozen=True)
class Alignment:
    """``aligned = scale * rotation @ point + translation``.

    Args:
        scale: positive.
        rotation: ``[3, 3]``.
        translation: ``[3]``.
    """

    scale: float
    rotation: Floats
    translation: Floats

    def points(self, points: Floats) -> Floats:
        """Points ``[..., 3]``, aligned."""
        return self.scale * points @ self.rotation.T + self.translation

    def camera(self, camera: Camera) -> Camera:
        """A camera that sees the aligned points where ``camera`` sees the points."""
        viewmat = camera.viewmat.clone()
        turned = camera.viewmat[:3, :3] @ torch.from_numpy(self.rotation.T.copy())
        viewmat[:3, :3] = turned
        viewmat[:3, 3] = self.scale * camera.viewmat[:3, 3] - turned @ torch.from_numpy(self.translation)
        return replace(camera, viewmat=viewmat, near=camera.near * self.scale)

    def filmed(self, filmed: LensCamera) -> LensCamera:
        """:meth:`camera` of a camera with a lens."""
        return LensCamera(self.camera(filmed.camera), filmed.lens)


def alignment(theirs: Mapping[str, Floats], ours: Mapping[str, Floats]) -> Alignment:
    """The similarity from ``theirs`` to ``ours``, world-to-camera matrices ``[4, 4]`` of the same names.

    The rotation is that of the cameras' axes, since positions alone do not give it when cameras stand in a line; scale
    and translation are least squares of the positions (Umeyama, PAMI 1991). Cameras that all stand at one place leave
    the scale at 1.
    """
    turns = sum(ours[name][:3, :3].T @ theirs[name][:3, :3] for name in theirs)
    u, _, vh = np.linalg.svd(turns)
    rotation = u @ np.diag([1, 1, np.linalg.det(u @ vh)]) @ vh
    from_, to = (np.array([_center(poses[name]) for name in theirs]) for poses in (theirs, ours))
    turned = (from_ - from_.mean(0)) @ rotation.T
    spread = float((turned**2).sum())
    scale = float((turned * (to - to.mean(0))).sum() / spread) if spread > 0 else 1.0
    return Alignment(scale, rotation, to.mean(0) - scale * rotation @ from_.mean(0))


def _center(viewmat: Floats) -> Floats:
    return -viewmat[:3, :3].T @ viewmat[:3, 3]

# SPDX-License-Identifier: Apache-2.0
"""Sampling interval of a scene by its training cameras: the size of a training pixel at a point.

Note [Drawn as it was trained]
~~~~~~~~~~~~~~~~~~~~~~~~~~~~~~
A scene is trained with the rasteriser's low-pass, 0.3 square pixels *of the training pictures*, and the Gaussians adapt
to it. If the scene is drawn three times as large with 0.3 square pixels of the larger picture, nine tenths of the
low-pass are missing and edges look hairy; at half the size everything becomes too thick. So the low-pass belongs to the
scene, as a variance of 0.3 squared sampling intervals at each Gaussian. If the drawn picture needs more against
aliasing, the difference is added without adding light (``kernels.reference_raster.screen_low_pass``). At a training
camera's own size the two are equal. The interval (Mip-Splatting's term) is a mean over the cameras that see a point.
"""

import weakref
from dataclasses import dataclass, field

import torch
from torch import Tensor

from structgstream.cameras import Camera, CameraRig

INNER_SHARE = 0.55
"""A camera has full weight for points up to this share of the picture's size from its middle, slightly beyond the
border."""
BORDER_SHARE = 0.1
"""Over this share of the picture's size the weight then falls to that of cameras that do not see the point. A sudden
change would be visible when anchors move across a border."""
UNSEEN_WEIGHT = 1e-4
"""Weight of a camera for a point in front of it but outside its picture: decisive if no camera sees the point."""
_REMEMBERED = 4


@dataclass(frozen=True)
class RigSampling:
    """The properties of the training cameras that :meth:`intervals` needs.

    Args:
        projections: ``[V, 3, 4]`` float64, from scene to shares of the picture's width and height, times the depth.
        focals: ``[V]`` float64, geometric mean of a camera's two focal lengths, pixels.
    """

    projections: Tensor
    focals: Tensor
    _moved: dict[tuple[torch.dtype, torch.device], tuple[Tensor, Tensor]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )
    _found: "list[tuple[weakref.ref[Tensor], int, Tensor]]" = field(
        default_factory=list, init=False, repr=False, compare=False
    )

    @classmethod
    def of(cls, rig: CameraRig) -> "RigSampling":
        """The sampling by the training cameras of ``rig``, in its units."""
        cameras = [rig[name] for name in rig.training]
        return cls(torch.stack([_projection(camera) for camera in cameras]), torch.stack(list(map(_focal, cameras))))

    def intervals(self, points: Tensor) -> Tensor:
        """The side ``[N]`` of a training pixel at each of ``points`` ``[N, 3]``, scene units, without gradient.

        The weighted mean of depth over focal length; zero if a point is behind all cameras. Results for the last few
        tensors that are not trained are cached.
        """
        if points.requires_grad:
            return self._intervals(points.detach())
        version = points._version
        for reference, at, intervals in self._found:
            if reference() is points and at == version:
                return intervals
        intervals = self._intervals(points)
        self._found[:] = [(weakref.ref(points), version, intervals), *self._found[: _REMEMBERED - 1]]
        return intervals

    def _intervals(self, points: Tensor) -> Tensor:
        projections, focals = self._on(points)
        x, y, depths = (torch.addmm(rows[:, 3], points, rows[:, :3].T) for rows in projections.unbind(1))  # [N, V]
        ahead = depths > 0
        depths = torch.where(ahead, depths, 1.0)
        # In place: this runs in every iteration that moves Gaussians.
        weights = _inside(x.div_(depths)).mul_(_inside(y.div_(depths))).add_(UNSEEN_WEIGHT).mul_(ahead)
        total = weights.sum(1).clamp_(min=torch.finfo(points.dtype).tiny)
        return weights.mul_(depths).matmul(1.0 / focals).div_(total)

    def _on(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """The cameras with the dtype and device of ``points``; cached, because a copy to a GPU blocks the host."""
        key = (points.dtype, points.device)
        if key not in self._moved:
            self._moved[key] = self.projections.to(points), self.focals.to(points)
        return self._moved[key]


def _inside(share: Tensor) -> Tensor:
    """Weight of a coordinate given as a share of the picture's size; computed in place."""
    edge = INNER_SHARE + BORDER_SHARE
    return share.sub_(0.5).abs_().neg_().add_(edge).div_(BORDER_SHARE).clamp_(0.0, 1.0)


def _projection(camera: Camera) -> Tensor:
    size = torch.tensor([[camera.width], [camera.height], [1.0]], dtype=torch.float64)
    return camera.K / size @ camera.viewmat[:3]


def _focal(camera: Camera) -> Tensor:
    return (camera.K[0, 0] * camera.K[1, 1]).sqrt()

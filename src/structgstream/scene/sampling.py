# SPDX-License-Identifier: Apache-2.0
"""How finely the training cameras sampled a scene: the size of a training pixel at a point.

Note [Drawn as it was trained]
~~~~~~~~~~~~~~~~~~~~~~~~~~~~~~
A scene is trained through the low-pass of a rasteriser, 0.3 square pixels *of the training pictures*. It is a part of
what was trained: drawn three times as large with 0.3 square pixels of the larger picture, nine tenths of it are missing
and edges look hairy; drawn at half the size everything becomes too thick. So the low-pass belongs to the scene, as a
variance of 0.3 squared sampling intervals at each Gaussian, and only where that is less than the picture at hand needs
against aliasing is the rest added, without adding light (``kernels.reference_raster.screen_low_pass``). At a training
camera's own size the two are the same. The interval (Mip-Splatting's term) is a mean over the cameras that see a point.
"""

import weakref
from dataclasses import dataclass, field

import torch
from torch import Tensor

from structgstream.cameras import Camera, CameraRig

INNER_SHARE = 0.55
"""Up to this share of a picture's size from its middle a camera counts fully: a little beyond the border."""
BORDER_SHARE = 0.1
"""Over this share of the picture's size its weight then falls to that of cameras that do not see the point, so that
nothing pops when anchors move across a border."""
UNSEEN_WEIGHT = 1e-4
"""Of a camera in front of which a point lies outside of its picture: it decides where no camera sees the point."""
_REMEMBERED = 4


@dataclass(frozen=True)
class RigSampling:
    """The training cameras, as far as :meth:`intervals` needs them.

    Args:
        projections: ``[V, 3, 4]`` float64, scene to picture as shares of its width and height, times the depth.
        focals: ``[V]`` float64, pixels, the geometric mean of a camera's two.
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
        """Of the training cameras of ``rig``, in its units."""
        cameras = [rig[name] for name in rig.training]
        return cls(torch.stack([_projection(camera) for camera in cameras]), torch.stack(list(map(_focal, cameras))))

    def intervals(self, points: Tensor) -> Tensor:
        """The side ``[N]`` of a training pixel at each of ``points`` ``[N, 3]``, scene units, without gradient.

        The weighted mean of depth over focal length; zero where all cameras look away. Kept for the last few tensors
        that are not trained.
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
        """The cameras with the dtype and device of ``points``; kept, because a copy to a GPU blocks the host."""
        key = (points.dtype, points.device)
        if key not in self._moved:
            self._moved[key] = self.projections.to(points), self.focals.to(points)
        return self._moved[key]


def _inside(share: Tensor) -> Tensor:
    """Weight by a coordinate as a share of the picture's size, in place."""
    edge = INNER_SHARE + BORDER_SHARE
    return share.sub_(0.5).abs_().neg_().add_(edge).div_(BORDER_SHARE).clamp_(0.0, 1.0)


def _projection(camera: Camera) -> Tensor:
    size = torch.tensor([[camera.width], [camera.height], [1.0]], dtype=torch.float64)
    return camera.K / size @ camera.viewmat[:3]


def _focal(camera: Camera) -> Tensor:
    return (camera.K[0, 0] * camera.K[1, 1]).sqrt()

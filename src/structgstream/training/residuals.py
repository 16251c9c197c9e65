# SPDX-License-Identifier: Apache-2.0
"""Residuals of renderings against the training pictures, and their baseline: the residuals of frame 0.

Residuals that frame 0 already had do not indicate change.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from structgstream.kernels.backend import Backend
from structgstream.scene.color import CameraColor
from structgstream.scene.render import draw
from structgstream.scene.scene import Scene
from structgstream.training.views import View, dilated, in_groups, stacked_masks

BASELINE_PIXELS = 5
"""Side, in pixels of its maps, of the square over which the baseline takes the maximum residual."""


@dataclass(frozen=True)
class BaselineResidual:
    """Residuals of frame 0 by training view.

    Args:
        scale: size of the maps (``View.evidence``).
        maps: by view index ``[h, w]``, maximum residual over the 5 x 5 pixels around each, in 0 ... 1, and 1 where a
            mask left a pixel out. Cameras that were absent from frame 0 have none: their residuals indicate nothing.
    """

    scale: float
    maps: dict[int, Tensor]

    def capped(self, changed: Mapping[int, Tensor], *, medians: float) -> "BaselineResidual":
        """The baseline, with at most ``medians`` times a view's median where it has changed.

        Frame 0's residual there was of other content, and does not show how well the present content can be drawn.

        Args:
            changed: by view index, mask ``[h, w]`` of the changed pixels, at the maps' scale.
            medians: 0: no baseline there.
        """
        changed = {index: mask for index, mask in changed.items() if index in self.maps}

        def capped(indices: list[int]) -> Tensor:
            baselines = torch.stack([self.maps[index] for index in indices])
            # Without what a mask left out. No median (everything is left out): fmin then keeps the baseline.
            usual = medians * torch.where(baselines < 1.0, baselines, torch.nan).flatten(1).nanmedian(1).values
            return torch.where(
                torch.stack([changed[index] for index in indices]),
                torch.fmin(baselines, usual[:, None, None]),
                baselines,
            )

        if not changed:
            return self
        device = next(iter(self.maps.values())).device
        found = in_groups(list(changed), lambda index: self.maps[index].shape, capped, device=device)
        return replace(self, maps={**self.maps, **dict(zip(changed, found, strict=True))})


def apply_camera_color(image: Tensor, color: CameraColor, view_index: int) -> Tensor:
    """A rendering ``[H, W, 3]`` with the training camera's colour correction."""
    return recorded(image, color.gains[view_index], color.biases[view_index])


def recorded(image: Tensor, gains: Tensor, biases: Tensor) -> Tensor:
    """``gains * image + biases`` of a rendering ``[..., H, W, 3]``; the two are ``[..., 3]``."""
    # By rows instead of pixels of three numbers, which takes a sixth of the time.
    factors, summands = (t.repeat(*[1] * (t.dim() - 1), image.shape[-2]).unsqueeze(-2) for t in (gains, biases))
    return (image.flatten(-2) * factors + summands).reshape(image.shape)


def box_mean(values: Tensor, pixels: int) -> Tensor:
    """Mean of ``values`` ``[..., H, W]`` over the ``pixels`` x ``pixels`` around each, inside the picture. By shifted
    sums, which take a fifth of ``avg_pool2d``'s time."""
    reach = pixels // 2
    rows, columns = (_sum_around(torch.ones(size), 0, reach) for size in values.shape[-2:])
    counts = (rows[:, None] * columns).to(values)
    return _sum_around(_sum_around(values, -2, reach), -1, reach) / counts


def _sum_around(values: Tensor, dim: int, reach: int) -> Tensor:
    """Sums over ``reach`` elements on each side along ``dim``, as far as they exist."""
    total, size = values.clone(), values.shape[dim]
    for shift in range(1, min(reach, size - 1) + 1):
        total.narrow(dim, shift, size - shift).add_(values.narrow(dim, 0, size - shift))
        total.narrow(dim, 0, size - shift).add_(values.narrow(dim, shift, size - shift))
    return total


def residuals(drawn: Sequence[Tensor], views: Sequence[View], color: CameraColor, backend: Backend) -> Tensor:
    """Mean absolute difference ``[V, H, W]`` of renderings ``[H, W, 3]`` to the pictures of ``views`` of one size, over
    channels and 3 x 3 pixels, after the corrections ``color`` of their cameras; 0 where pixels do not count."""
    seen, pictures = color.of_cameras([view.index for view in views]), torch.stack([view.image for view in views])
    return backend.picture_residuals(drawn, pictures, gains=seen.gains, biases=seen.biases, masks=stacked_masks(views))


def mean_residual(scene: Scene, views: Sequence[View], *, scale: float, backend: Backend) -> float:
    """Mean over ``views`` of the mean absolute difference of ``scene`` to the picture, reduced by ``scale``
    (``View.evidence``).

    Masked pixels are left out; a view that is masked everywhere counts as 0.
    """
    sums = []
    for view, found in _reduced_residuals(scene, views, scale, backend):
        pixels = found.numel() if view.mask is None else max(int(view.mask.sum()), 1)
        sums.append(float(found.sum(dtype=torch.float64)) / pixels)
    return sum(sums) / max(len(sums), 1)


def baseline_residual(scene: Scene, views: Sequence[View], *, scale: float, backend: Backend) -> BaselineResidual:
    """Residuals of ``scene``, the decoded frame 0, in pictures reduced by ``scale`` (``View.evidence``)."""
    maps = {}
    for view, found in _reduced_residuals(scene, views, scale, backend):
        baseline = dilated(found, BASELINE_PIXELS // 2)
        maps[view.index] = baseline if view.mask is None else torch.where(view.mask, baseline, 1.0)
    return BaselineResidual(scale, maps)


def _reduced_residuals(
    scene: Scene, views: Sequence[View], scale: float, backend: Backend
) -> Iterator[tuple[View, Tensor]]:
    """Each of ``views`` reduced by ``scale`` (``View.evidence``), and the residuals of ``scene`` there."""
    scene = scene.with_folded_appearance()
    for view in views:
        small = view.evidence(scale)
        with torch.no_grad():
            gaussians, background = scene.gaussians(small.camera, backend), scene.background(small.camera)
            drawn = draw(gaussians, small.camera, backend, background=background).image
            (found,) = residuals([drawn], [small], scene.camera_color, backend)
        yield small, found

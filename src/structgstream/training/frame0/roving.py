# SPDX-License-Identifier: Apache-2.0
"""Pictures of a roving camera in the iterations of frame 0.

Note [What only the roving pictures show]
~~~~~~~~~~~~~~~~~~~~~~~~~~~~~~~~~~~~~~~~~
Where people are in frame 0 is masked beforehand (``data/roving.py``). People who walk about while the roving camera
films are in few of its pictures, in others what is behind them. The scene follows the others, so these people stay as
residuals: cells of a picture whose residual is several times the picture's median are left out at its next visit, as
in robust fits (RobustNeRF, Sabour et al., CVPR 2023). Where the scene covers nothing yet, nothing is left out.

A phone exposes each frame anew, and a view is visited too seldom for a gain to be learned by small steps. So the gains
of a roving picture are those that fit its last rendering best, and are no parameters.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain

import torch
from torch import Tensor

from structgstream.frames import RovingPicture
from structgstream.scene.color import CameraColor
from structgstream.scene.render import Rendering
from structgstream.scene.scene import Scene
from structgstream.training.views import View, area_mean, blackened, coarse_to_fine

COLORS_FROM = 0.05  # share of the iterations after which gains follow the renderings
OUTLIERS_FROM = 0.3  # share of the iterations after which outliers are left out
MAX_GAIN = 2.0
COVERED = 0.5  # coverage below which a pixel shows no surface yet
CELLS = 48  # along the longer side of a picture, whose residuals are compared
OUTLIER_MEDIANS = 4.0  # residual of a cell, in medians of its picture, beyond which it is an outlier
OUTLIER_FLOOR = 0.08  # in 0 ... 1; smaller residuals are none
MEMORY = 0.5  # weight of the earlier residuals of a cell


@dataclass
class RovingViews:
    """The roving pictures as views; their indices follow those of the training cameras.

    Args:
        first: number of training cameras.
        colors: whether gains are fitted.
        gains: ``[R, 3]``.
        residuals: ``[h, w]`` of the cells of each picture, as last seen; None before.
        outliers: ``[h, w]`` bool of each picture; None for none.
    """

    views: list[View]
    first: int
    colors: bool
    gains: Tensor
    residuals: list[Tensor | None]
    outliers: list[Tensor | None]

    @classmethod
    def of(cls, pictures: Sequence[RovingPicture], *, first: int, colors: bool, device: torch.device) -> "RovingViews":
        """The views of ``pictures``, whose cameras are in normalised units."""
        views = []
        for number, picture in enumerate(pictures):
            mask = torch.from_numpy(picture.mask).to(device)
            image = blackened(torch.from_numpy(picture.image).to(device), mask)
            views.append(View(first + number, picture.camera, image, mask))
        none = [None] * len(views)
        return cls(views, first, colors, torch.ones(len(views), 3, device=device), [*none], [*none])

    def has(self, view: View) -> bool:
        """Whether ``view`` is one of these, whatever its size."""
        return view.index >= self.first

    def applied(self, scene: Scene, view: View) -> tuple[Scene, View]:
        """``scene`` with a colour for ``view``, and ``view`` without what is left out."""
        number, color = view.index - self.first, scene.camera_color
        gains = self.gains[number : number + 1]
        own = CameraColor(torch.cat([color.gains, gains]), torch.cat([color.biases, torch.zeros_like(gains)]))
        mask = view.mask
        assert mask is not None, "of each"
        mask = mask & self._inliers(number, mask)
        changed = replace(view, index=len(color.gains), image=blackened(view.image, mask), mask=mask)
        return replace(scene, camera_color=own), changed

    def note(self, view: View, rendering: Rendering, *, share: float) -> None:
        """Fits gains and finds outliers after ``view`` was drawn, at this share of the iterations."""
        number, mask = view.index - self.first, view.mask
        assert mask is not None, "of each"
        with torch.no_grad():
            image, truth = rendering.image.detach(), view.colors
            counts = (mask & (rendering.alpha.detach() > COVERED)).float()
            if self.colors and share >= COLORS_FROM:
                self._fit_gains(number, image, truth, counts)
            residual = (image * self.gains[number]).clamp(0.0, 1.0).sub_(truth).abs_().mean(2)
            height, width = counts.shape
            cell = max(height, width) / CELLS
            size = max(min(height, round(height / cell)), 1), max(min(width, round(width / cell)), 1)
            sums, share_counting = area_mean(torch.stack([residual * counts, counts])[:, None], size)[:, 0]
            cells = sums / share_counting.clamp(min=1e-6)
            before = self.residuals[number]
            if before is not None:
                cells = MEMORY * before + (1 - MEMORY) * cells
            self.residuals[number] = cells
            counting = share_counting > COVERED
            if share >= OUTLIERS_FROM and bool(counting.any()):
                most = (OUTLIER_MEDIANS * cells[counting].median()).clamp(min=OUTLIER_FLOOR)
                self.outliers[number] = counting & (cells > most)

    def _fit_gains(self, number: int, image: Tensor, truth: Tensor, counts: Tensor) -> None:
        """The gains of least squares, without the outliers."""
        counts = counts * self._inliers(number, counts)
        weighed = image * counts[..., None]
        found = (weighed * truth).sum((0, 1)) / (weighed * image).sum((0, 1)).clamp(min=1e-6)
        if float(counts.mean()) > MIN_COUNTING:
            self.gains[number] = found.clamp(1 / MAX_GAIN, MAX_GAIN)

    def _inliers(self, number: int, like: Tensor) -> Tensor:
        """Mask of a picture's size, that of ``like`` ``[H, W]``, without its outliers."""
        outliers = self.outliers[number]
        if outliers is None:
            return torch.ones_like(like, dtype=torch.bool)
        whole = torch.nn.functional.interpolate(outliers[None, None].float(), size=like.shape, mode="nearest")
        return whole[0, 0] == 0


MIN_COUNTING = 0.05  # share of a picture's pixels that gains need


def alternating(
    views: list[View], roving: list[View], stages: Sequence[tuple[int, float]], *, generator: torch.Generator
) -> Iterator[View]:
    """Endless shuffled views, by turns of the training cameras and of the roving one; ``stages`` as of
    :func:`coarse_to_fine`."""
    halves = [(-(-count // 2), scale) for count, scale in stages]
    both = (coarse_to_fine(own, halves, generator=generator) for own in (views, roving))
    return chain.from_iterable(zip(*both, strict=True))

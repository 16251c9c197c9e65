# SPDX-License-Identifier: Apache-2.0
"""What keeps frame 0 from explaining each camera alone: dropout and noise, a depth regulariser, and the removal of
floaters.

A rig sees a surface from few directions, so combinations of Gaussians can fit the training views and be wrong between
them. Dropping some Gaussians and perturbing the others in every iteration gives such combinations a large loss.

A haze of faint Gaussians around a surface can fit every training view and be wrong in all others; its depths along a
ray are spread. The regulariser is the standard deviation of depth relative to its mean (compare the distortion loss of
Mip-NeRF 360, Barron et al., CVPR 2022).

Note [Free space]
~~~~~~~~~~~~~~~~~
F_alpha sees the direction, so an anchor near one camera can be opaque for that camera alone, and make up for its lens
or its exposure there. From any other place near it, what F_alpha says is chance: a viewer who comes close stands in a
haze. A surface is not like that: few cameras see it in front of what they draw. So an anchor goes if many cameras see
something behind it, and hardly any of them draws it. What masks leave out is no evidence: a roving camera, which films
an empty room, would see through the people of frame 0.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar

import torch
from torch import Tensor

from structgstream.cameras import Camera
from structgstream.gaussians import Gaussians
from structgstream.kernels.backend import Backend
from structgstream.scene.scene import Scene
from structgstream.training.views import View, dilated

TABLE_LENGTH = 1 << 21
"""Of a table of random numbers; it is a few times what an iteration reads."""


@dataclass(frozen=True)
class PerturbationConfig:
    """Dropout and perturbation while frame 0 is trained."""

    dropped_share: float = 0.0
    """Share of the Gaussians dropped in an iteration; the others' opacities are scaled up accordingly (paper: 0)."""
    noise_scales: float = 0.0
    """Standard deviation of normal noise on the means, in units of each Gaussian's own scale (paper: 0)."""

    UNTIL_SHARE: ClassVar[float] = 0.7
    """Both decrease linearly to 0 at this share of the iterations."""


class RandomNumbers:
    """Random numbers that are read from random places of tables: to draw them anew takes a thirtieth of frame 0.

    Args:
        generator: of the tables and of the places.
        device: of the numbers.
        length: of a table. It grows where more are read at once.
    """

    def __init__(self, generator: torch.Generator, device: torch.device, *, length: int = TABLE_LENGTH) -> None:
        self._generator = generator
        self._device = device
        self._length = length
        self._tables: dict[str, Tensor] = {}

    def uniform(self, count: int) -> Tensor:
        """``[count]`` in [0, 1)."""
        return self._read("uniform", count)

    def normal(self, count: int) -> Tensor:
        """``[count, 3]`` of mean 0 and deviation 1."""
        return self._read("normal", 3 * count).reshape(count, 3)

    def _read(self, name: str, count: int) -> Tensor:
        table = self._tables.get(name)
        if table is None or len(table) < 2 * count:
            draw = torch.rand if name == "uniform" else torch.randn
            length = max(self._length, 2 * count)
            table = self._tables[name] = draw(length, generator=self._generator).to(self._device)
        first = int(torch.randint(len(table) - count + 1, (), generator=self._generator))
        return table[first : first + count]


def perturbed(
    gaussians: Gaussians, config: PerturbationConfig, numbers: RandomNumbers, *, strength: float
) -> Gaussians:
    """The Gaussians of one iteration with dropout and noise; ``strength``, 0 to 1, is a factor on their amounts."""
    dropped, noise = strength * config.dropped_share, strength * config.noise_scales
    opacities, means = gaussians.opacities, gaussians.means
    if dropped > 0.0:
        kept = (numbers.uniform(len(gaussians)) >= dropped).to(opacities)
        opacities = (opacities * kept.div_(1.0 - dropped)).clamp(max=0.999)
    if noise > 0.0:
        # Isotropic noise by the mean scale: following each Gaussian's rotation is not worth its cost.
        x, y, z = gaussians.scales.detach().unbind(1)
        sizes = (x + y).add_(z).mul_(noise / 3.0)  # by columns: a mean of three takes six times as long
        means = means + sizes[:, None] * numbers.normal(len(gaussians)).to(means)
    return replace(gaussians, opacities=opacities, means=means)


def perturbation_at(
    iteration: int, iterations: int, config: PerturbationConfig, numbers: RandomNumbers
) -> Callable[[Gaussians], Gaussians] | None:
    """:func:`perturbed` in ``iteration`` of ``iterations``; None for none."""
    strength = 1.0 - iteration / max(1.0, iterations * config.UNTIL_SHARE)
    if strength <= 0.0 or not (config.dropped_share or config.noise_scales):
        return None
    return partial(perturbed, config=config, numbers=numbers, strength=strength)


COVERED = 0.5
"""Pixels with less coverage show no surface: their depth is not counted, and nothing is in front of one there."""


@dataclass(frozen=True)
class DepthDistortionConfig:
    """Weight and schedule of the depth regulariser; not in the paper."""

    weight: float = 0.0
    """Mean weight of the depth spread in the loss per iteration (paper: 0)."""

    FROM_SHARE: ClassVar[float] = 0.3
    """Share of the iterations before it starts, in which surfaces form."""
    EVERY: ClassVar[int] = 4
    """It is computed in every ``EVERY``-th iteration, with ``EVERY`` times the weight."""
    SCALE: ClassVar[float] = 0.5
    """Scale of width and height of the pictures in which depth is drawn."""

    def weight_at(self, iteration: int, iterations: int) -> float:
        """Weight of the depth spread in ``iteration`` of ``iterations``; 0: it is not computed."""
        if iteration <= self.FROM_SHARE * iterations or iteration % self.EVERY:
            return 0.0
        return self.weight * self.EVERY


def depth_distortion(gaussians: Gaussians, camera: Camera, *, scale: float, backend: Backend) -> Tensor:
    """Relative spread of depth along rays, ``[]``.

    The standard deviation of depth, weighted by blending weights, relative to the mean depth, averaged over the pixels
    with coverage above :data:`COVERED`. It takes one more rendering, with "colours" z, z^2 and 1.
    """
    small = camera.scaled(scale)
    viewport = small.viewport(gaussians.means)
    depths = gaussians.means @ viewport.viewmat[2, :3] + viewport.viewmat[2, 3]
    moments = torch.stack([depths, depths.square(), torch.ones_like(depths)], dim=1)
    image = backend.rasterize(replace(gaussians, colors=moments), viewport).image
    first, second, coverage = image.unbind(-1)
    covered = coverage.detach() > COVERED
    divisor = coverage.clamp(min=COVERED)  # Avoids NaN in pixels that are not counted.
    mean = (first / divisor).clamp(min=small.near)
    variance = (second / divisor - mean.square()).clamp(min=0.0)
    spread = (variance + 1e-8).sqrt() / mean
    return (spread * covered).sum() / covered.sum().clamp(min=1)


@dataclass(frozen=True)
class FreeSpaceConfig:
    """Removal of anchors in free space (Note [Free space]); not in the paper."""

    enabled: bool = False
    """Remove anchors in free space after the last iteration (paper: no)."""

    DEPTH_SHARE: ClassVar[float] = 0.9
    """An anchor is in front of what a camera draws if its depth is below this share of the drawn depth."""
    MIN_CAMERAS: ClassVar[int] = 6
    """An anchor is judged only if as many cameras see it in front of what they draw."""
    DRAWN_SHARE: ClassVar[float] = 0.34
    """It is removed if at most this share of them, or a single one, draws one of its Gaussians."""
    DRAWN_OPACITY: ClassVar[float] = 0.05
    """Opacity above which a Gaussian counts as drawn."""
    SCALE: ClassVar[float] = 0.5
    """Scale of width and height of the pictures in which depth is drawn."""


def in_free_space(scene: Scene, views: Sequence[View], *, config: FreeSpaceConfig, backend: Backend) -> Tensor:
    """Mask ``[M]`` of the anchors of ``scene`` that float in front of surfaces, as the cameras of ``views`` see it.

    Pixels that do not count (``training/views.py``, Note [Masked pixels]) show no surface.
    """
    in_front = scene.anchors.positions.new_zeros(len(scene.anchors))
    drawn = torch.zeros_like(in_front)
    with torch.no_grad():
        for view in views:
            small = view.reduced(config.SCALE)
            structured = scene.structured(small.camera, backend)
            rows = structured.anchors
            before = _before_surfaces(scene.anchors.positions[rows], scene, small, config.DEPTH_SHARE, backend)
            opaque = structured.raw_opacities.amax(1) > config.DRAWN_OPACITY
            in_front[rows] += before.to(in_front)
            drawn[rows] += (before & opaque).to(drawn)
    return (in_front >= config.MIN_CAMERAS) & (drawn <= (config.DRAWN_SHARE * in_front).clamp(min=1.0))


def _before_surfaces(points: Tensor, scene: Scene, view: View, share: float, backend: Backend) -> Tensor:
    """Mask ``[n]`` of the points in the picture of ``view`` that are nearer than ``share`` of the depth drawn there."""
    camera, viewport = view.camera, view.camera.viewport(points)
    depth = _nearest_depth(scene, camera, backend)
    depth = depth if view.mask is None else torch.where(view.mask, depth, 0.0)
    at = points @ viewport.viewmat[:3, :3].T + viewport.viewmat[:3, 3]
    x, y, z = (at @ viewport.K.T).unbind(1)
    column, row = (x / z).floor().long(), (y / z).floor().long()
    inside = (z > viewport.near) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    drawn = depth[row.clamp(0, camera.height - 1), column.clamp(0, camera.width - 1)]
    return inside & (z < share * drawn)


def _nearest_depth(scene: Scene, camera: Camera, backend: Backend) -> Tensor:
    """``[H, W]`` the least drawn depth of 3 x 3 pixels; 0 where one of them shows no surface."""
    gaussians = scene.gaussians(camera, backend)
    viewport = camera.viewport(gaussians.means)
    z = gaussians.means @ viewport.viewmat[2, :3] + viewport.viewmat[2, 3]
    moments = torch.stack([z, torch.ones_like(z), torch.zeros_like(z)], dim=1)
    first, coverage, _ = backend.rasterize(replace(gaussians, colors=moments), viewport).image.unbind(-1)
    depth = torch.where(coverage > COVERED, first / coverage.clamp(min=COVERED), 0.0)
    return -dilated(-depth, 1)

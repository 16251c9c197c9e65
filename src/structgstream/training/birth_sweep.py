# SPDX-License-Identifier: Apache-2.0
"""What a rendering lacks, and the free Gaussians that fill it: one sweep of ``training/births.py`` over a frame."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from structgstream.cameras import Camera
from structgstream.gaussians import concatenate
from structgstream.kernels.backend import Backend
from structgstream.kernels.values import TileSelection
from structgstream.scene.focus import Focus
from structgstream.scene.free import FreeGaussians
from structgstream.scene.render import draw
from structgstream.scene.scene import Scene
from structgstream.training.births import BirthConfig, Births, ViewResidual, sweep_births, view_residual
from structgstream.training.partition import changed_tiles
from structgstream.training.residuals import ResidualFloor
from structgstream.training.views import View, mean_of_counting

LEAST_COVERAGE = 0.5
"""Pixels with less coverage have no depth."""
DEPTH_WIDTH = 240
"""Depth maps are drawn at most this wide, pixels, and enlarged: they cost most of a frame without births."""


@dataclass(frozen=True)
class Missing:
    """Missing pixels of a view.

    Args:
        view: in full size.
        residual: of the rendering.
        tiles: those in which something is missing or wrong, or all; None for a view without a focus.
        picture: ``[H, W, 3]`` the rendering; None for a view without a focus.
        drawn: mask ``[rows, columns]`` of the tiles in which it is not the focus's; None for none.
    """

    view: View
    residual: ViewResidual
    tiles: TileSelection | None
    picture: Tensor | None = None
    drawn: Tensor | None = None

    @property
    def any(self) -> bool:
        """Whether there are any."""
        return bool((self.residual.missing_share > 0.5).any())


def missing_share(missing: Sequence[Missing]) -> float:
    """Share of the pixels of all views that are missing."""
    shares = [mean_of_counting((m.residual.missing_share > 0.5).float(), m.residual.view.mask) for m in missing]
    return float(torch.stack(shares).mean())


@dataclass(frozen=True)
class Sweep:
    """One sweep.

    Args:
        moving: the moving part after the motion start, with folded appearance.
        still: the rest, with folded appearance.
        views: of the frame.
        focuses: by view index, the focus on the moving part.
        floor: residuals of frame 0; None for none.
        config: the rules.
        backend: the compute back-end.
        known: by view index, what a sweep of the same Gaussians by other rules has drawn.
    """

    moving: Scene
    still: Scene
    views: Sequence[View]
    focuses: Mapping[int, Focus]
    floor: ResidualFloor | None
    config: BirthConfig
    backend: Backend
    known: Mapping[int, Missing] = field(default_factory=dict)

    def missing(self, *, blames: bool = True) -> list[Missing]:
        """Missing pixels of every view, none outside its focus.

        Args:
            blames: whether free Gaussians will be blamed for wrong pixels, which then have to be right too.
        """
        # ``focuses`` are from before the second round: tiles without missing pixels then are assumed to have none now.
        found = [self._before(view, wrong=blames) for view in self.views]
        every = blames and len(self.moving.free) > 0
        if not every and not self._enough(found):
            return found
        return [self._drawn(entry) if every or entry.any else entry for entry in found]

    def drawn(self, missing: Sequence[Missing]) -> list[Missing]:
        """The same views, drawn again."""
        return [self._drawn(entry, again=True) for entry in missing]

    def births(self, missing: Sequence[Missing], *, first_birth: int, room: int) -> Births:
        """New free Gaussians where several views miss the same; at most ``room``."""
        if not self._enough(missing):
            return Births(FreeGaussians.empty(self.moving.free.means))
        residuals = [entry.residual for entry in missing]
        return sweep_births(
            residuals,
            {entry.view.index: self.depth_map(entry.view) for entry in residuals},
            self.moving.camera_color,
            first_birth=first_birth,
            config=replace(self.config, most=min(self.config.most, room)),
            backend=self.backend,
        )

    def _enough(self, missing: Sequence[Missing]) -> bool:
        """Whether enough views have missing pixels for a birth."""
        return sum(entry.any for entry in missing) > self.config.least_supports

    def _before(self, view: View, *, wrong: bool) -> Missing:
        """By the picture that is drawn already; ``wrong`` pixels make their tiles suspect, too."""
        focus, known = self.focuses.get(view.index), self.known.get(view.index)
        if focus is None:
            return Missing(view, self._residual(view, None), None)
        picture = focus.picture if known is None or known.picture is None else known.picture
        residual = self._residual(view, picture)
        suspect = residual.missing_share > 0.5
        tiles = changed_tiles(focus.tiles, suspect | residual.wrong if wrong else suspect)
        return Missing(view, residual, tiles, picture, None if known is None else known.drawn)

    def _drawn(self, entry: Missing, *, again: bool = False) -> Missing:
        """By a rendering, in the suspect tiles; in those drawn before only ``again``."""
        view, focus = entry.view, self.focuses.get(entry.view.index)
        if focus is None or entry.picture is None:
            return entry
        tiles = entry.tiles or focus.tiles
        if entry.drawn is not None and not again:
            tiles = replace(tiles, mask=tiles.mask & ~entry.drawn)
            if not tiles.mask.any():
                return entry
        onto = replace(focus, picture=entry.picture.clone(), tiles=tiles)
        gaussians = self.moving.with_free_gaussians(self.moving.structured(view.camera, self.backend, tiles=tiles))
        behind = self.moving.background(view.camera)
        image = draw(gaussians, view.camera, self.backend, focus=onto, background=behind).image
        drawn = tiles.mask if entry.drawn is None else tiles.mask | entry.drawn
        return replace(entry, residual=self._residual(view, image), picture=image, drawn=drawn)

    def _residual(self, view: View, image: Tensor | None) -> ViewResidual:
        """Of a rendering ``[H, W, 3]`` within the focus; None for a view without one."""
        focus = self.focuses.get(view.index)
        return view_residual(
            None if focus is None else image,
            view,
            self.moving.camera_color,
            floor=self.floor,
            config=self.config,
            backend=self.backend,
            tiles=None if focus is None else focus.tiles,
        )

    def depth_map(self, view: View) -> Tensor:
        """Mean depth along z ``[h, w]`` of both parts drawn together; infinite where coverage is low.

        Of the still part only what reaches the focus is drawn, if there is one: beyond it nothing has changed, so a
        point that projects there is refused as if it were visible.
        """
        camera, focus = _reduced(view.camera), self.focuses.get(view.index)
        at_rest = self.still.gaussians(camera, self.backend) if focus is None else focus.still
        gaussians = concatenate(self.moving.gaussians(camera, self.backend), at_rest)
        viewmat = camera.viewport(gaussians.means).viewmat
        z = gaussians.means @ viewmat[2, :3] + viewmat[2, 3]
        rendering = draw(replace(gaussians, colors=z[:, None].expand(-1, 3).contiguous()), camera, self.backend)
        depth = rendering.image[..., 0] / rendering.alpha.clamp(min=LEAST_COVERAGE)
        depth = torch.where(rendering.alpha > LEAST_COVERAGE, depth, torch.inf)
        return interpolate(depth[None, None], size=(view.camera.height, view.camera.width))[0, 0]


def _reduced(camera: Camera) -> Camera:
    scale = min(1.0, DEPTH_WIDTH / camera.width)
    return camera.resized(*(max(1, round(pixels * scale)) for pixels in (camera.width, camera.height)))

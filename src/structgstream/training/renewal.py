# SPDX-License-Identifier: Apache-2.0
"""Renewal of free Gaussians after the motion start: removal of outliers, and births where content is missing."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from structgstream.gaussians import concatenate
from structgstream.kernels.backend import Backend
from structgstream.kernels.raster_types import TileSelection
from structgstream.scene.focus import Focus
from structgstream.scene.free import FreeGaussians
from structgstream.scene.render import draw
from structgstream.scene.scene import Scene
from structgstream.training.births import BirthConfig, ViewResidual, blamed_mask, sweep_births, view_residual
from structgstream.training.observation import gather_maps
from structgstream.training.partition import Partition, changed_tiles
from structgstream.training.residuals import ResidualFloor, apply_camera_color
from structgstream.training.views import View, mean_of_counting

LEAST_COVERAGE = 0.5
"""Pixels with less coverage have no depth."""
DEPTH_WIDTH = 240
"""Depth maps are drawn at most this wide, pixels, and enlarged: they cost most of a frame without births."""


@dataclass(frozen=True)
class Renewal:
    """Result of the renewal of a moving part's free Gaussians.

    Args:
        kept: mask ``[F]`` of those that are kept.
        new_free: those that are born.
        missing_share: share of missing pixels in all training views.
        refused: whether too much is missing for births.
    """

    kept: Tensor
    new_free: FreeGaussians
    missing_share: float = 0.0
    refused: bool = False


def renew_free_gaussians(
    partition: Partition,
    views: Sequence[View],
    focuses: Mapping[int, Focus],
    *,
    first_birth: int,
    floor: ResidualFloor | None,
    room: int,
    least_pixels: float,
    config: BirthConfig,
    backend: Backend,
) -> Renewal:
    """Removal and births of free Gaussians before the first iteration.

    Args:
        partition: with its moving part after the motion start.
        views: of the frame.
        focuses: by view index, the focus on the moving part.
        first_birth: identity of the first birth.
        floor: residuals of frame 0; None for none.
        room: largest number of births.
        least_pixels: views where a Gaussian covers fewer pixels do not count.
        config: the rules.
        backend: the compute back-end.
    """
    moving = partition.moving.with_folded_appearance()
    everything = torch.ones(len(moving.free), dtype=torch.bool, device=moving.free.means.device)
    none = Renewal(everything, FreeGaussians.empty(moving.free.means))
    if not config.enabled or not focuses:
        return none
    with torch.no_grad():
        # ``focuses`` are from before the second round: tiles without missing pixels then are assumed to have none now.
        missing = [_view_residual(moving, view, focuses, None, floor=floor, config=config) for view in views]
        if not len(moving.free) and not _enough_views_miss(missing, config):
            return none
        tiles = {entry.view.index: _suspect_tiles(entry, focuses) for entry in missing}
        again = [len(moving.free) > 0 or _has_missing_pixels(entry) for entry in missing]
        missing = [
            _view_residual(moving, view, focuses, backend, tiles=tiles, floor=floor, config=config) if drawn else entry
            for entry, view, drawn in zip(missing, views, again, strict=True)
        ]
        shares = [mean_of_counting((entry.missing_share > 0.5).float(), entry.view.mask) for entry in missing]
        share = float(torch.stack(shares).mean())
        if share > config.most_missing_share:
            return replace(none, missing_share=share, refused=True)
        kept = everything
        if len(moving.free):
            kept = ~_blamed_mask(moving, missing, focuses, least_pixels=least_pixels, config=config, backend=backend)
        if not kept.all():
            moving = replace(moving, free=moving.free.select(kept))
            missing = [
                _view_residual(moving, view, focuses, backend, tiles=tiles, floor=floor, config=config)
                for view in views
            ]
        if not _enough_views_miss(missing, config):
            return replace(none, kept=kept, missing_share=share)
        still = partition.still.with_folded_appearance()
        depths = {entry.view.index: _depth_map(moving, still, entry.view, focuses, backend) for entry in missing}
        new = sweep_births(
            missing,
            depths,
            moving.camera_color,
            first_birth=first_birth,
            config=replace(config, most=max(0, min(config.most, room - int(kept.sum())))),
            backend=backend,
        )
    return Renewal(kept, new, share)


def _suspect_tiles(entry: ViewResidual, focuses: Mapping[int, Focus]) -> TileSelection | None:
    """The tiles of the focus with missing or wrong pixels, or all; None for a view without a focus."""
    focus = focuses.get(entry.view.index)
    return None if focus is None else changed_tiles(focus.tiles, entry.wrong | (entry.missing_share > 0.5))


def _has_missing_pixels(entry: ViewResidual) -> bool:
    return bool((entry.missing_share > 0.5).any())


def _enough_views_miss(missing: Sequence[ViewResidual], config: BirthConfig) -> bool:
    """Whether enough views have missing pixels for a birth."""
    return sum(map(_has_missing_pixels, missing)) > config.least_supports


def _view_residual(
    moving: Scene,
    view: View,
    focuses: Mapping[int, Focus],
    backend: Backend | None,
    *,
    tiles: Mapping[int, TileSelection | None] | None = None,
    floor: ResidualFloor | None,
    config: BirthConfig,
) -> ViewResidual:
    """Missing pixels of a view, none outside the focus.

    The rendering is drawn by ``backend``, only in ``tiles`` if they are given, or without one taken from ``focuses``.
    """
    focus, picture = focuses.get(view.index), view.colors
    if focus is not None:
        image = focus.picture
        if backend is not None:
            drawn = (tiles or {}).get(view.index) or focus.tiles
            onto = replace(focus, picture=focus.picture.clone(), tiles=drawn)
            gaussians = moving.with_free_gaussians(moving.structured(view.camera, backend, tiles=drawn))
            behind = moving.background(view.camera)
            image = draw(gaussians, view.camera, backend, focus=onto, background=behind).image
        inside = focus.tiles.pixels()[..., None]
        picture = torch.where(inside, apply_camera_color(image, moving.camera_color, view.index), picture)
    return view_residual(picture.clamp(0.0, 1.0), view, floor=floor, config=config)


def _blamed_mask(
    moving: Scene,
    missing: Sequence[ViewResidual],
    focuses: Mapping[int, Focus],
    *,
    least_pixels: float,
    config: BirthConfig,
    backend: Backend,
) -> Tensor:
    coverage, wrong = [], []
    for entry in missing:
        focus, camera = focuses.get(entry.view.index), entry.view.camera
        if focus is None:
            continue
        wrong_pixels = entry.wrong.to(entry.missing_share)
        counting = torch.ones_like(wrong_pixels) if entry.view.mask is None else entry.view.mask.to(wrong_pixels)
        maps = torch.stack([counting, wrong_pixels], dim=-1)
        sums = gather_maps(moving.gaussians(camera, backend), moving, camera, maps, backend, still=focus.still)
        of_free = sums[len(sums) - len(moving.free) :]
        coverage.append(of_free[:, 0])
        wrong.append(of_free[:, 1])
    return blamed_mask(torch.stack(coverage), torch.stack(wrong), least_pixels=least_pixels, config=config)


def _depth_map(moving: Scene, still: Scene, view: View, focuses: Mapping[int, Focus], backend: Backend) -> Tensor:
    """Mean depth along z ``[h, w]`` of both parts drawn together; infinite where coverage is low.

    Of the still part only what reaches the focus is drawn, if there is one: beyond it nothing has changed, so a point
    that projects there is refused as if it were visible.
    """
    size, scale = (view.camera.height, view.camera.width), min(1.0, DEPTH_WIDTH / view.camera.width)
    camera = view.camera.resized(*(max(1, round(pixels * scale)) for pixels in (view.camera.width, view.camera.height)))
    focus = focuses.get(view.index)
    at_rest = still.gaussians(camera, backend) if focus is None else focus.still
    gaussians = concatenate(moving.gaussians(camera, backend), at_rest)
    viewmat = camera.viewport(gaussians.means).viewmat
    z = gaussians.means @ viewmat[2, :3] + viewmat[2, 3]
    rendering = draw(replace(gaussians, colors=z[:, None].expand(-1, 3).contiguous()), camera, backend)
    depth = rendering.image[..., 0] / rendering.alpha.clamp(min=LEAST_COVERAGE)
    depth = torch.where(rendering.alpha > LEAST_COVERAGE, depth, torch.inf)
    return interpolate(depth[None, None], size=size)[0, 0]

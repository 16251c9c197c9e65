# SPDX-License-Identifier: Apache-2.0
"""Operations over several views of one picture size, without gradients: one view after the other, which defines them.

Before and after the iterations of a frame every view is drawn once. A GPU does it for all of them in one call
(``cuda_picture``, ``cuda_anchors``), so that the host queues and waits once and not for each view.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from structgstream.cameras import Viewport
from structgstream.gaussians import Gaussians, concatenate
from structgstream.kernels import reference_anchors, reference_raster
from structgstream.kernels.values import (
    TILE_PIXELS,
    Anchors,
    MLPWeights,
    Rasterizer,
    RasterOutput,
    StructuredGaussians,
    TileSelection,
    tile_grid,
)

REACH_SHARE = 0.6
"""A Gaussian's reach relative to its extent: it is truncated at two standard deviations."""


@dataclass(frozen=True)
class ViewByView:
    """The operations over views by operations on one view, which ``reference_anchors`` and ``reference_raster`` define.

    Gaussians of a view are ascending by id (Note [Ids]); rows of opacity 0 are invisible.

    Args:
        generate_structured: of a back-end.
        rasterize: of a back-end.
        projected_radii: extents ``[N]`` on a picture.
        blending_weights: sums ``[N, C]``, Gaussian by Gaussian.
        picture_and_weights: both in one pass.
    """

    generate_structured: Callable[..., StructuredGaussians]
    rasterize: Rasterizer
    projected_radii: Callable[[Gaussians, Viewport], Tensor]
    blending_weights: Callable[[Gaussians, Viewport, Tensor], Tensor]
    picture_and_weights: Callable[..., tuple[Tensor, Tensor]]

    def generate_views(
        self,
        anchors: Anchors,
        mlps: MLPWeights,
        viewports: Sequence[Viewport],
        *,
        free: Gaussians,
        distance_input: bool,
        tiles: Sequence[TileSelection] | None = None,
        sampling_intervals: Tensor | None = None,
    ) -> list[Gaussians]:
        """The Gaussians to draw in each view: structured ones, then all free ones.

        Args:
            anchors: of the scene.
            mlps: of the scene.
            viewports: the cameras, with one near plane.
            free: free Gaussians.
            distance_input: whether the distance is an input of the heads.
            tiles: by view; if given, only anchors that reach one of these tiles.
            sampling_intervals: ``[M]`` of the anchors; None: the low-pass is that of the picture.
        """
        found = []
        k = anchors.offsets.shape[1]
        of_slots = None if sampling_intervals is None else sampling_intervals.repeat_interleave(k)
        for n, viewport in enumerate(viewports):
            structured = self.generate_structured(
                anchors,
                mlps,
                viewport,
                distance_input=distance_input,
                tiles=None if tiles is None else tiles[n],
                sampling_intervals=sampling_intervals,
            ).gaussians
            if of_slots is not None:
                structured = replace(structured, sampling_intervals=of_slots.index_select(0, structured.ids))
            found.append(concatenate(structured, free) if len(free) else structured)
        return found

    def draw_views(
        self,
        gaussians: Sequence[Gaussians],
        viewports: Sequence[Viewport],
        *,
        static: Sequence[Gaussians] | None = None,
        backgrounds: Tensor | None = None,
        tiles: Sequence[TileSelection] | None = None,
        onto: Sequence[Tensor] | None = None,
    ) -> list[RasterOutput]:
        """``rasterize`` of each view, without graph.

        Args:
            gaussians: of each view.
            viewports: the cameras.
            static: further Gaussians of each view, whose radii follow.
            backgrounds: ``[V, 3]``, black when None.
            tiles: to draw in each view, all when None.
            onto: the pictures that are drawn into in place, with ``tiles``.
        """
        with torch.no_grad():
            return [
                self.rasterize(
                    every,
                    viewports[n],
                    background=None if backgrounds is None else backgrounds[n],
                    tiles=None if tiles is None else tiles[n],
                    onto=None if onto is None else onto[n],
                )
                for n, every in enumerate(_with_static(gaussians, static))
            ]

    def weigh_views(
        self,
        gaussians: Sequence[Gaussians],
        viewports: Sequence[Viewport],
        maps: Tensor,
        *,
        slots: int,
        static: Sequence[Gaussians] | None = None,
    ) -> Tensor:
        """Sums ``[V, slots, C]`` by id over the pixels of each Gaussian's blending weight times each map, no graph.

        Args:
            gaussians: of each view.
            viewports: the cameras.
            maps: ``[V, H, W, C]``, C at least 1.
            slots: number of ids (Note [Ids]); those that are not in a view have 0.
            static: further Gaussians of each view, which only take part in occlusion.
        """
        sums = maps.new_zeros(len(viewports), slots, maps.shape[-1])
        for n, every in enumerate(_with_static(gaussians, static)):
            found = self.blending_weights(every, viewports[n], maps[n])
            sums[n, gaussians[n].ids] = found[: len(gaussians[n])]
        return sums

    def draw_and_weigh_views(
        self,
        gaussians: Sequence[Gaussians],
        viewports: Sequence[Viewport],
        maps: Tensor,
        *,
        slots: int,
        backgrounds: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """The pictures ``[V, H, W, 3]`` of :meth:`draw_views` and the sums of :meth:`weigh_views`, without graph."""
        sums, pictures = maps.new_zeros(len(viewports), slots, maps.shape[-1]), []
        for n, of_view in enumerate(gaussians):
            background = None if backgrounds is None else backgrounds[n]
            picture, found = self.picture_and_weights(of_view, viewports[n], maps[n], background=background)
            sums[n, of_view.ids] = found
            pictures.append(picture)
        return torch.stack(pictures), sums

    def reached_tiles(
        self,
        gaussians: Sequence[Gaussians],
        viewports: Sequence[Viewport],
        visible: Tensor,
        *,
        reduced: Sequence[Viewport],
        margin_pixels: int,
    ) -> Tensor:
        """Mask ``[V, rows, columns]`` of the tiles within ``margin_pixels`` of visible Gaussians.

        Args:
            gaussians: of each view.
            viewports: the cameras.
            visible: mask ``[V, slots]`` by id.
            reduced: the cameras with the smaller pictures on which extents are measured.
            margin_pixels: of the pictures.
        """
        found = []
        for n, (of_view, viewport, small) in enumerate(zip(gaussians, viewports, reduced, strict=True)):
            radii = self.projected_radii(of_view, small) * (viewport.width / small.width)
            shown = (visible[n, of_view.ids] & (radii > 0)).nonzero()[:, 0]
            found.append(tiles_around(of_view.means[shown], radii[shown], viewport, margin_pixels))
        return torch.stack(found)


def _with_static(gaussians: Sequence[Gaussians], static: Sequence[Gaussians] | None) -> Sequence[Gaussians]:
    return gaussians if static is None else list(map(concatenate, gaussians, static))


def tiles_around(means: Tensor, radii: Tensor, viewport: Viewport, margin_pixels: int) -> Tensor:
    """Mask ``[rows, columns]`` of the tiles within ``margin_pixels`` of Gaussians at ``means`` ``[N, 3]``, ``radii``
    ``[N]`` pixels large."""
    rows, columns = tile_grid(viewport.width, viewport.height)
    points = means @ viewport.viewmat[:3, :3].T + viewport.viewmat[:3, 3]
    centers = (points @ viewport.K.T)[:, :2] / points[:, 2:]
    reach = REACH_SHARE * radii[:, None] + margin_pixels
    none, last = centers.new_zeros(2), centers.new_tensor([columns - 1, rows - 1])
    low = ((centers - reach) / TILE_PIXELS).floor()
    high = ((centers + reach) / TILE_PIXELS).floor()
    inside = ((high >= none) & (low <= last)).all(1)
    low = low[inside].clamp(min=none, max=last).long()
    high = high[inside].clamp(min=none, max=last).long() + 1
    # Each box adds one at two of its corners and takes one at the others; running sums then count boxes.
    corners = torch.zeros((rows + 1) * (columns + 1), device=centers.device)
    one = torch.ones(len(low), device=centers.device)
    for x, y, sign in ((low, low, 1), (high, high, 1), (low, high, -1), (high, low, -1)):
        corners.index_add_(0, y[:, 1] * (columns + 1) + x[:, 0], sign * one)
    counts = corners.reshape(rows + 1, columns + 1).cumsum(0).cumsum(1)[:rows, :columns]
    return counts > 0.5


ORACLE = ViewByView(
    reference_anchors.generate_structured,
    reference_raster.rasterize,
    reference_raster.projected_radii,
    reference_raster.blending_weights,
    reference_raster.picture_and_weights,
)

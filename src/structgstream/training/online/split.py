# SPDX-License-Identifier: Apache-2.0
"""A scene in two parts, dynamic and static, and the tiles that the dynamic one reaches.

The dynamic part is a scene with the same MLPs and its own ids (Note [Ids]); training it costs in proportion to its
size.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from structgstream.cameras import enlargement
from structgstream.gaussians import row_indices, select_each
from structgstream.kernels.backend import Backend, on_processor
from structgstream.kernels.values import TILE_PIXELS, TileSelection
from structgstream.scene.active_tiles import ActiveTiles
from structgstream.scene.scene import Scene
from structgstream.training.online.config import MotionConfig
from structgstream.training.online.select import DynamicSelection
from structgstream.training.views import View, by_size, dilated

REACH_SCALE = 0.25


@dataclass(frozen=True)
class DynamicSplit:
    """A scene in two parts.

    Args:
        whole: the scene.
        selection: which primitives are dynamic.
        dynamic: the dynamic part.
        static: the static part.
    """

    whole: Scene
    selection: DynamicSelection
    dynamic: Scene
    static: Scene

    @classmethod
    def of(cls, scene: Scene, selection: DynamicSelection) -> "DynamicSplit":
        """``scene`` in two parts."""

        def part(anchors: Tensor, free: Tensor) -> Scene:
            return replace(scene, anchors=scene.anchors.select(anchors), free=scene.free.select(free))

        dynamic = part(selection.anchors, selection.free)
        return cls(scene, selection, dynamic, part(~selection.anchors, ~selection.free))

    def displaced(self, displacements: Tensor) -> "DynamicSplit":
        """The same with the primitives of its dynamic part shifted by ``[M + F, 3]``."""
        return replace(self, dynamic=with_displacements(self.dynamic, displacements))

    def merge(self, moved: Scene) -> Scene:
        """The whole scene with its dynamic part replaced by ``moved``; the static part keeps its bits.

        ``moved`` has the anchors of ``dynamic``; free Gaussians may have been added and removed.
        """
        free = self.static.free.append(moved.free)
        return replace(
            self.whole,
            anchors=self.whole.anchors.with_rows(self.selection.anchors, moved.anchors),
            free=free.select(free.births.argsort()),  # Identities ascend and are unique.
        )


def with_displacements(scene: Scene, displacements: Tensor) -> Scene:
    """``scene``, its primitives (Note [Primitives]) shifted by ``[M + F, 3]``."""
    m = len(scene.anchors)
    return replace(
        scene,
        anchors=replace(scene.anchors, positions=scene.anchors.positions + displacements[:m]),
        free=replace(scene.free, means=scene.free.means + displacements[m:]),
    )


def find_active_tiles(
    split: DynamicSplit, views: Sequence[View], *, config: MotionConfig, backend: Backend
) -> dict[int, ActiveTiles]:
    """By view index, the tiles that the dynamic part reaches; views that do not show it have none."""
    with torch.no_grad():
        found = by_size(views, lambda same: _active_tiles(split, same, config, backend))
    return {view.index: active for view, active in zip(views, found, strict=True) if active is not None}


def _active_tiles(
    split: DynamicSplit, views: Sequence[View], config: MotionConfig, backend: Backend
) -> list[ActiveTiles | None]:
    """Of views of one size; None where the dynamic part is not visible."""
    selection = split.selection
    dynamic, static = (part.with_folded_appearance() for part in (split.dynamic, split.static))
    like, k = dynamic.anchors.positions, dynamic.anchors.offsets_per_anchor
    of_dynamic = row_indices(torch.cat([selection.anchors.repeat_interleave(k), selection.free]), like)
    cameras = [view.camera for view in views]
    width, height = cameras[0].width, cameras[0].height
    enlarged = enlargement(width, height)
    in_motion = dynamic.gaussians_of_views(cameras, backend)
    masks = backend.reached_tiles(
        in_motion,
        [camera.viewport(like) for camera in cameras],
        torch.stack([selection.visible[view.index] for view in views])[:, of_dynamic],
        # Extents are those on a reduced picture.
        reduced=[camera.scaled(REACH_SCALE).viewport(like) for camera in cameras],
        margin_pixels=round(config.MARGIN_PIXELS * enlarged),
    )
    changed = changed_tiles(masks, [selection.changed.get(view.index) for view in views], (height, width))
    if config.tiles_around >= 0:
        masks = masks & dilated(changed, round(config.tiles_around * enlarged))
    # The loss reads ten pixels beyond a tile: a ring of tiles around them is drawn once and kept.
    tiles, tiles_of_change, rings = (
        [TileSelection(mask, width, height) for mask in of_views] for of_views in (masks, changed, dilated(masks, 1))
    )
    at_rest, backgrounds = static.gaussians_of_views(cameras, backend, tiles=rings), static.backgrounds(cameras)
    drawn = backend.draw_views(
        in_motion,
        [camera.viewport(like) for camera in cameras],
        static=at_rest,
        backgrounds=backgrounds,
        tiles=rings,
    )
    # Anchors were culled as a whole; Gaussians that reach no tile are dropped.
    radii = torch.cat([output.radii[len(of_view) :] for output, of_view in zip(drawn, in_motion, strict=True)])
    reaching, shown = on_processor(radii > 0, masks.flatten(1).any(1))
    kept = select_each(at_rest, reaching)
    return [
        ActiveTiles(
            tiles[n],
            drawn[n].image,
            kept[n],
            tiles_of_change[n],
            None if backgrounds is None else backgrounds[n],
        )
        if shown[n]
        else None
        for n in range(len(views))
    ]


def changed_tiles(masks: Tensor, changed: Sequence[Tensor | None], size: tuple[int, int]) -> Tensor:
    """Those of the tiles ``[V, rows, columns]`` that hold pixels of a view's mask ``[h, w]``; all if none do or there
    is no mask.

    Args:
        masks: tiles of each view.
        changed: the mask of each view.
        size: H and W of the pictures.
    """
    known = [mask for mask in changed if mask is not None]
    if not known:
        return masks
    everywhere = torch.ones_like(known[0])
    pixels = torch.stack([everywhere if mask is None else mask for mask in changed])[:, None].to(torch.uint8)
    rows, columns = masks.shape[1:]
    large = torch.nn.functional.interpolate(pixels, size=size)
    padded = torch.nn.functional.pad(large, (0, columns * TILE_PIXELS - size[1], 0, rows * TILE_PIXELS - size[0]))
    of_tiles = padded.reshape(-1, rows, TILE_PIXELS, columns, TILE_PIXELS)
    found = masks & (of_tiles.amax(2).amax(3) > 0)  # both at once, in float, take three to five times as long
    return torch.where(found.flatten(1).any(1)[:, None, None], found, masks)

# SPDX-License-Identifier: Apache-2.0
"""A scene in two parts, dynamic and static, and the tiles that the dynamic one reaches.

The dynamic part is a scene with the same MLPs and its own ids (Note [Ids]); training it costs in proportion to its
size.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from structgstream.cameras import Camera, enlargement
from structgstream.gaussians import concatenate
from structgstream.kernels.backend import Backend
from structgstream.kernels.values import TILE_PIXELS, TileSelection, tile_grid
from structgstream.scene.active_tiles import ActiveTiles
from structgstream.scene.render import draw
from structgstream.scene.scene import Scene
from structgstream.training.online.config import MotionConfig
from structgstream.training.online.select import DynamicSelection
from structgstream.training.views import View

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
    selection, dynamic, static = (
        split.selection,
        split.dynamic.with_folded_appearance(),
        split.static.with_folded_appearance(),
    )
    k = dynamic.anchors.offsets_per_anchor
    rows = torch.cat([selection.anchors.repeat_interleave(k), selection.free])  # of the whole scene's Gaussians
    with torch.no_grad():
        found = {
            view.index: _active_tiles(
                static,
                dynamic,
                selection.visible[view.index][rows],
                selection.changed.get(view.index),
                view.camera,
                config,
                backend,
            )
            for view in views
        }
    return {index: active for index, active in found.items() if active is not None}


def _active_tiles(
    static: Scene,
    dynamic: Scene,
    visible: Tensor,
    changed: Tensor | None,
    camera: Camera,
    config: MotionConfig,
    backend: Backend,
) -> ActiveTiles | None:
    in_motion = dynamic.gaussians(camera, backend)
    # Extents are those on a reduced picture.
    small = camera.scaled(REACH_SCALE)
    radii = backend.projected_radii(in_motion, small.viewport(in_motion.means)) * (camera.width / small.width)
    enlarged = enlargement(camera.width, camera.height)
    shown = visible[in_motion.ids] & (radii > 0)
    tiles = reached_tiles(in_motion.means[shown], radii[shown], camera, round(config.MARGIN_PIXELS * enlarged))
    if not tiles.mask.any():
        return None
    tiles_of_change = changed_tiles(tiles, changed)
    if config.tiles_around >= 0:
        tiles = replace(tiles, mask=tiles.mask & _grown(tiles_of_change.mask, round(config.tiles_around * enlarged)))
    # The loss reads ten pixels beyond a tile: a ring of tiles around them is drawn once and kept.
    ring = replace(tiles, mask=_grown(tiles.mask, 1))
    at_rest = static.with_free_gaussians(static.structured(camera, backend, tiles=ring))
    nothing = at_rest.select(torch.zeros(len(at_rest), dtype=torch.bool, device=ring.mask.device))
    empty = at_rest.means.new_zeros(camera.height, camera.width, 3)
    drawn, behind = concatenate(in_motion, at_rest), static.background(camera)
    rendering = draw(drawn, camera, backend, active=ActiveTiles(ring, empty, nothing), background=behind)
    # Anchors were culled as a whole; Gaussians that reach no tile are dropped.
    return ActiveTiles(
        tiles, rendering.image, at_rest.select(rendering.radii[len(in_motion) :] > 0), tiles_of_change, behind
    )


def _grown(mask: Tensor, by: int) -> Tensor:
    """The mask ``[rows, columns]``, dilated by ``by`` tiles."""
    return torch.nn.functional.max_pool2d(mask[None].float(), 2 * by + 1, stride=1, padding=by)[0] > 0


def changed_tiles(tiles: TileSelection, changed: Tensor | None) -> TileSelection:
    """Those of ``tiles`` that hold pixels of the mask ``changed`` ``[h, w]``, or all if none do or it is None."""
    if changed is None:
        return tiles
    rows, columns = tiles.mask.shape
    size = (rows * TILE_PIXELS, columns * TILE_PIXELS)
    large = torch.nn.functional.interpolate(changed[None, None].float(), size=(tiles.height, tiles.width))
    padded = torch.nn.functional.pad(large, (0, size[1] - tiles.width, 0, size[0] - tiles.height))
    mask = tiles.mask & (torch.nn.functional.max_pool2d(padded, TILE_PIXELS)[0, 0] > 0.0)
    return replace(tiles, mask=mask) if mask.any() else tiles


def reached_tiles(means: Tensor, radii: Tensor, camera: Camera, margin_pixels: int) -> TileSelection:
    """The tiles within ``margin_pixels`` of Gaussians at ``means`` ``[N, 3]``, ``radii`` ``[N]`` pixels large.

    Gaussians are truncated at two standard deviations.
    """
    rows, columns = tile_grid(camera.width, camera.height)
    viewmat, K = camera.viewport(means)[:2]
    points = means @ viewmat[:3, :3].T + viewmat[:3, 3]
    centers = (points @ K.T)[:, :2] / points[:, 2:]
    reach = 0.6 * radii[:, None] + margin_pixels
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
    return TileSelection(counts > 0.5, camera.width, camera.height)

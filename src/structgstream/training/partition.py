# SPDX-License-Identifier: Apache-2.0
"""A scene taken apart into what moves in a frame and what stands still, and put together again.

The moving part is a scene of its own with the same MLPs: a trainer works on it as on any other, at the cost of what
moves. Its ids are its own (Note [Ids]).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import torch
from torch import Tensor

from structgstream.cameras import Camera
from structgstream.gaussians import concatenate
from structgstream.kernels.backend import Backend
from structgstream.kernels.raster_types import TILE_PIXELS, tiles_of
from structgstream.scene.focus import Focus
from structgstream.scene.render import draw
from structgstream.scene.scene import Scene
from structgstream.training.motion import MotionConfig, Moving
from structgstream.training.views import View


@dataclass(frozen=True)
class Partition:
    """A scene in two parts.

    Args:
        whole: as it was.
        which: what the moving part holds.
        moving: that part.
        still: the rest, but for free Gaussians that are not seen.
    """

    whole: Scene
    which: Moving
    moving: Scene
    still: Scene

    @classmethod
    def of(cls, scene: Scene, which: Moving) -> "Partition":
        """Take ``scene`` apart."""

        def part(anchors: Tensor, free: Tensor) -> Scene:
            return replace(scene, anchors=scene.anchors.select(anchors), free=scene.free.select(free))

        moving = part(which.anchors, which.free)
        return cls(scene, which, moving, part(~which.anchors, ~(which.free | which.unseen)))

    def together(self, moved: Scene) -> Scene:
        """The whole scene, its moving part replaced by ``moved``; what stood still keeps its bits.

        ``moved`` has the anchors of ``moving``; free Gaussians may have come and gone.
        """
        free = self.still.free.append(moved.free)
        return replace(
            self.whole,
            anchors=self.whole.anchors.with_rows(self.which.anchors, moved.anchors),
            free=free.select(free.births.argsort()),  # Births ascend, and are never used twice.
        )


def focuses(partition: Partition, views: Sequence[View], *, config: MotionConfig, backend: Backend) -> dict[int, Focus]:
    """By index, the views that the moving part shows in, and where."""
    which, moving = partition.which, partition.moving.baked()
    whole, still = partition.whole.baked(), partition.still.baked()
    k = moving.anchors.offsets_per_anchor
    rows = torch.cat([which.anchors.repeat_interleave(k), which.free])  # of the whole scene's Gaussians
    found: dict[int, Focus] = {}
    with torch.no_grad():
        for view in views:
            tiles = moving_tiles(whole, rows, view.camera, config=config, backend=backend)
            if tiles.any():
                tiles = tiles if config.tiles else torch.ones_like(tiles)
                found[view.index] = _focus(still, moving, tiles, view.camera, backend)
    return found


def _focus(still: Scene, moving: Scene, tiles: Tensor, camera: Camera, backend: Backend) -> Focus:
    # The loss looks ten pixels beyond a tile: a ring of tiles around them is drawn once and stays as it is.
    ring = torch.nn.functional.max_pool2d(tiles[None].float(), 3, stride=1, padding=1)[0] > 0
    structured, _ = still.structured(camera, backend, tiles=ring)
    at_rest = still.dressed(structured)
    nothing = at_rest.select(torch.zeros(len(at_rest), dtype=torch.bool, device=ring.device))
    empty = at_rest.means.new_zeros(camera.height, camera.width, 3)
    in_motion = moving.gaussians(camera, backend)
    rendering = draw(concatenate(in_motion, at_rest), camera, backend, focus=Focus(ring, empty, nothing))
    return Focus(tiles, rendering.image, at_rest)


def moving_tiles(scene: Scene, moving: Tensor, camera: Camera, *, config: MotionConfig, backend: Backend) -> Tensor:
    """Mask of the tiles in which Gaussians of the mask ``moving`` ``[M * K + F]`` (Note [Ids]) show, or could soon.

    They show where they make more than ``config.least_weight`` of a pixel, and could within ``config.margin_pixels``.
    """
    small = camera.resized(*(max(1, round(size * config.picture_scale)) for size in (camera.width, camera.height)))
    gaussians = scene.gaussians(small, backend)
    colors = moving[gaussians.ids].to(gaussians.colors)[:, None].expand(-1, 3).contiguous()
    weights = draw(replace(gaussians, colors=colors), small, backend).image[..., 0]
    reach = math.ceil(config.margin_pixels * config.picture_scale)
    near = (weights > config.least_weight).float()
    near = torch.nn.functional.max_pool2d(near[None], 2 * reach + 1, stride=1, padding=reach)[0] > 0
    tiles = near.new_zeros(tiles_of(camera.width, camera.height))
    y, x = near.nonzero().unbind(1)
    # A small pixel covers a box of large ones, which two tiles can share.
    ends = (0.0, 1.0 - 1e-4)
    rows = [((y + end) * (camera.height / small.height / TILE_PIXELS)).long() for end in ends]
    columns = [((x + end) * (camera.width / small.width / TILE_PIXELS)).long() for end in ends]
    for row, column in product(rows, columns):
        tiles[row, column] = True
    return tiles

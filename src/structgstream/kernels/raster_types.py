# SPDX-License-Identifier: Apache-2.0
"""What rasterisers share: tiles, and what every one returns."""

from dataclasses import dataclass

import torch
from torch import Tensor

TILE_PIXELS = 16
"""Side of a tile: the unit in which a part of a picture can be asked for."""


def tiles_of(width: int, height: int) -> tuple[int, int]:
    """Rows and columns of tiles of a picture; the last ones may be cut off."""
    return -(-height // TILE_PIXELS), -(-width // TILE_PIXELS)


def pixels_of_tiles(tiles: Tensor, width: int, height: int) -> Tensor:
    """A mask of tiles ``[rows, columns]`` as a mask of pixels ``[H, W]``."""
    return tiles.repeat_interleave(TILE_PIXELS, 0).repeat_interleave(TILE_PIXELS, 1)[:height, :width]


def count_pixels(tiles: Tensor, width: int, height: int) -> int:
    """Number of pixels in a mask of tiles ``[rows, columns]``."""
    rows, columns = tiles_of(width, height)
    heights = tiles.new_full((rows,), TILE_PIXELS, dtype=torch.int64)
    widths = tiles.new_full((columns,), TILE_PIXELS, dtype=torch.int64)
    heights[-1] -= rows * TILE_PIXELS - height
    widths[-1] -= columns * TILE_PIXELS - width
    return int(heights @ tiles.to(torch.int64) @ widths)


@dataclass(frozen=True)
class RasterOutput:
    """One rendering.

    Args:
        image: ``[H, W, 3]``, not clamped; zero (or what was there) in tiles that were not asked for.
        alpha: ``[H, W]`` coverage in [0, 1].
        radii: ``[N]`` float32 pixels, 0 where a Gaussian was not drawn.
    """

    image: Tensor
    alpha: Tensor
    radii: Tensor

# SPDX-License-Identifier: Apache-2.0
"""Tiles of pictures whose sides are no multiples of a tile."""

import pytest
import torch

from structgstream.kernels.raster_types import TILE_PIXELS, TileSelection, tile_grid

SIZES = [(16, 16), (17, 16), (1, 1), (48, 33), (50, 47)]


def test_tiles_cover_a_picture() -> None:
    assert [tile_grid(width, height) for width, height in SIZES] == [(1, 1), (1, 2), (1, 1), (3, 3), (3, 4)]


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_the_pixels_of_tiles_are_counted_without_being_made(width: int, height: int) -> None:
    rows, columns = tile_grid(width, height)
    for place in range(rows * columns):
        tiles = torch.zeros(rows, columns, dtype=torch.bool)
        tiles.view(-1)[place] = True
        selection = TileSelection(tiles, width, height)
        pixels = selection.pixels()
        assert pixels.shape == (height, width)
        assert selection.count_pixels() == int(pixels.sum())
        y, x = (int(axis.min()) for axis in torch.nonzero(pixels, as_tuple=True))
        assert (y // TILE_PIXELS, x // TILE_PIXELS) == divmod(place, columns)
    assert TileSelection(torch.ones(rows, columns, dtype=torch.bool), width, height).count_pixels() == width * height

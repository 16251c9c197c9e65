# SPDX-License-Identifier: Apache-2.0
"""Tiles of pictures whose sides are no multiples of a tile."""

import pytest
import torch

from structgstream.kernels.values import TILE_PIXELS, TileSelection, tile_grid

SIZES = [(16, 16), (17, 16), (1, 1), (48, 33), (50, 47)]


def test_tiles_cover_a_picture() -> None:
    assert [tile_grid(width, height) for width, height in SIZES] == [(1, 1), (1, 2), (1, 1), (3, 3), (3, 4)]


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_the_pixels_of_tiles_are_theirs(width: int, height: int) -> None:
    rows, columns = tile_grid(width, height)
    for place in range(rows * columns):
        tiles = torch.zeros(rows, columns, dtype=torch.bool)
        tiles.view(-1)[place] = True
        selection = TileSelection(tiles, width, height)
        pixels = selection.pixels()
        assert pixels.shape == (height, width)
        y, x = (int(axis.min()) for axis in torch.nonzero(pixels, as_tuple=True))
        assert (y // TILE_PIXELS, x // TILE_PIXELS) == divmod(place, columns)
    assert TileSelection(torch.ones(rows, columns, dtype=torch.bool), width, height).count_pixels() == width * height


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_tiles_of_pixels_are_those_that_hold_one(width: int, height: int) -> None:
    pixels = torch.zeros(height, width, dtype=torch.bool)
    assert not TileSelection.of(pixels).mask.any()
    pixels[-1, -1] = True
    found = TileSelection.of(pixels)
    assert (found.width, found.height) == (width, height)
    assert found.mask.nonzero().tolist() == [[size - 1 for size in tile_grid(width, height)]]
    assert found.pixels()[-1, -1]


def test_a_picture_of_two_has_one_in_the_tiles_and_the_other_around_them() -> None:
    selection = TileSelection(torch.tensor([[True, False], [False, True]]), 20, 18)
    one, other = (torch.rand(18, 20, 3, generator=torch.Generator().manual_seed(n)) for n in range(2))
    found, inside = selection.choose(one, other), selection.pixels()
    assert torch.equal(found[inside], one[inside])
    assert torch.equal(found[~inside], other[~inside])
    assert 0 < inside.sum() < inside.numel()

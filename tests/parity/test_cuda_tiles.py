# SPDX-License-Identifier: Apache-2.0
"""Tile lists of fixed size beside lists made one Gaussian at a time: those in torch and those of the kernels, whose
functions run on the processor, too.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import pairwise

import pytest
import torch
from torch import Tensor

from structgstream.kernels.cuda_library import KernelLibrary
from structgstream.kernels.cuda_tiles import (
    PairBudget,
    TileLists,
    radii_reaching_tiles,
    run_with_pair_budget,
    tile_lists,
    tile_lists_in_kernels,
)
from structgstream.kernels.reference_raster import boxes_reaching_tiles
from structgstream.kernels.values import TILE_PIXELS, TileSelection, tile_grid

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.needs_cuda)]
Listed = Callable[..., TileLists]


@pytest.fixture(params=["torch", "kernels"])
def listed(request: pytest.FixtureRequest, device: str, kernels_on: Callable[[str], KernelLibrary]) -> Listed:
    """The lists in torch or of the kernels, of tensors of ``device``."""
    return tile_lists if request.param == "torch" else partial(tile_lists_in_kernels, kernels_on(device))


def splats(count: int, width: int, height: int) -> tuple[Tensor, Tensor, Tensor]:
    """Some around the picture, some beyond it, some with the same depth, and what is not drawn full of rubbish."""
    means2d = torch.rand(count, 2) * torch.tensor([width * 1.4, height * 1.4]) - torch.tensor([width, height]) * 0.2
    radii = torch.randint(1, 40, (count, 2), dtype=torch.int32)
    depths = torch.rand(count).mul(20.0).round() + 1.0
    hidden = torch.rand(count) < 0.3
    radii[hidden, 1] = 0
    means2d[hidden], depths[hidden] = math.nan, math.nan
    return means2d, radii, depths


def expected(means2d: Tensor, radii: Tensor, depths: Tensor, width: int, height: int) -> list[list[int]]:
    """Each tile's list, as gsplat defines it."""
    rows, columns = tile_grid(width, height)
    lists: list[list[int]] = [[] for _ in range(rows * columns)]
    drawn = [i for i in range(len(depths)) if (radii[i] > 0).all()]
    for i in sorted(drawn, key=lambda i: (float(depths[i]), i)):
        edges = [
            (
                min(max(0, math.floor(float(means2d[i, axis] - radii[i, axis]) / TILE_PIXELS)), size),
                min(max(0, math.ceil(float(means2d[i, axis] + radii[i, axis]) / TILE_PIXELS)), size),
            )
            for axis, size in enumerate((columns, rows))
        ]
        for row in range(*edges[1]):
            for column in range(*edges[0]):
                lists[row * columns + column].append(i)
    return lists


def found(starts: Tensor, ids: Tensor) -> list[list[int]]:
    bounds = [*starts.flatten().tolist(), len(ids)]
    return [ids[a:b].tolist() for a, b in pairwise(bounds)]


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("size", [(75, 53), (64, 32), (5, 3)])
def test_each_tile_lists_its_gaussians_front_to_back(listed: Listed, device: str, size: tuple[int, int]) -> None:
    width, height = size
    values = splats(120, width, height)
    exact = expected(*values, width, height)
    count = sum(map(len, exact))
    assert count > 20
    for capacity in (count, count + 500):
        lists = listed(*(value.to(device) for value in values), width=width, height=height, capacity=capacity)
        rows, columns = tile_grid(width, height)
        assert lists.starts.shape == (rows + 1, columns)
        assert lists.starts.dtype == lists.ids.dtype == torch.int32
        assert int(lists.needed) == count
        ours = found(lists.starts.cpu(), lists.ids.cpu())
        assert ours[: rows * columns] == exact
        below = [len(ids) for ids in ours[rows * columns :]]
        assert sum(below) == capacity - count
        assert max(below) - min(below) <= 1
        assert lists.ids.min() >= 0
        assert lists.ids.max() < 120


@pytest.mark.parametrize("device", DEVICES)
def test_of_too_many_the_nearest_stay(listed: Listed, device: str) -> None:
    means2d, radii = torch.full((50, 2), 8.0), torch.full((50, 2), 2, dtype=torch.int32)
    depths = torch.arange(50.0).flip(0) + 1.0
    lists = listed(*(value.to(device) for value in (means2d, radii, depths)), width=16, height=16, capacity=20)
    assert int(lists.needed) == 50
    assert found(lists.starts, lists.ids)[0] == list(range(49, 29, -1))


@pytest.mark.parametrize("device", DEVICES)
def test_nothing_is_drawn(listed: Listed, device: str) -> None:
    means2d, radii = torch.full((4, 2), torch.nan), torch.zeros(4, 2, dtype=torch.int32)
    depths = torch.full((4,), torch.nan)
    lists = listed(*(value.to(device) for value in (means2d, radii, depths)), width=40, height=20, capacity=10)
    assert int(lists.needed) == 0
    assert [len(ids) for ids in found(lists.starts, lists.ids)[:6]] == [0] * 6


@pytest.mark.parametrize("device", DEVICES)
def test_a_picture_with_more_tiles_than_a_short_number_holds(listed: Listed, device: str) -> None:
    width, height = 200 * TILE_PIXELS, 170 * TILE_PIXELS
    means2d, radii = torch.tensor([[width - 1.0, height - 1.0]]), torch.ones(1, 2, dtype=torch.int32)
    lists = listed(*(v.to(device) for v in (means2d, radii, torch.ones(1))), width=width, height=height, capacity=3)
    assert found(lists.starts, lists.ids)[200 * 170 - 1] == [0]


@pytest.mark.parametrize("device", DEVICES)
def test_radii_of_those_that_reach_a_tile(device: str, kernels_on: Callable[[str], KernelLibrary]) -> None:
    means2d, radii, _ = splats(400, 75, 53)
    means2d = means2d.nan_to_num(1e30)
    tiles = TileSelection(torch.rand(tile_grid(75, 53)) < 0.2, 75, 53)
    reaching = boxes_reaching_tiles(means2d - radii, means2d + radii, tiles)
    exact = torch.where(reaching & (radii > 0).all(1), radii.amax(1).float(), 0.0)
    there = replace(tiles, mask=tiles.mask.to(device))
    given = (radii * (radii > 0).all(1, keepdim=True)).to(torch.int32)  # gsplat's radii are both 0, or none is
    ours = radii_reaching_tiles(kernels_on(device), means2d.to(device), given.to(device), there)
    assert torch.equal(ours.cpu(), exact)
    assert 20 < int((exact > 0).sum()) < int((given > 0).all(1).sum())


def test_places_need_no_order(emulation: Callable[[int], KernelLibrary]) -> None:
    values = splats(80, 75, 53)
    one, other = (
        tile_lists_in_kernels(emulation(order), *values, width=75, height=53, capacity=3000) for order in (0, 1)
    )
    assert all(torch.equal(a, b) for a, b in zip(one, other, strict=True))


def test_a_budget_remembers_the_worst_picture() -> None:
    budget = PairBudget.of(100, torch.device("cpu"))
    assert budget.shortage() == 0
    for needed, missing in ((90, 0), (130, 30), (10, 30)):
        torch.maximum(budget.needed, torch.tensor(needed), out=budget.needed)
        assert budget.shortage() == missing


def test_work_that_was_short_of_room_is_done_again() -> None:
    capacities = []

    def work(budget: PairBudget) -> str:
        capacities.append(budget.capacity)
        budget.needed.fill_(100)
        return "done"

    assert run_with_pair_budget(work, capacity=30, device=torch.device("cpu")) == "done"
    assert capacities == [30, 170]
    assert run_with_pair_budget(work, capacity=100, device=torch.device("cpu")) == "done"
    assert capacities == [30, 170, 100]

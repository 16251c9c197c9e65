# SPDX-License-Identifier: Apache-2.0
"""The hash grid against its definition, point by point and corner by corner."""

import itertools

import pytest
import torch
from torch import Tensor

from structgstream_studies.peers.hash_grid import PRIMES, Cache, GridConfig, GridQuery, corners, transformation

SMALL = GridConfig(levels=4, features=3, log2_rows=9, base=4, growth=2.0, hidden=8, outputs=8)


def naive(grid: Tensor, network: Tensor, point: Tensor, config: GridConfig) -> Tensor:
    """The outputs at one position, straight from Note [Grid]."""
    features, first = [], 0
    for level in range(config.levels):
        cells = config.base * config.growth**level - 1
        per_axis = int(torch.tensor(cells).ceil()) + 1
        size = min((per_axis**3 + 7) // 8 * 8, 2**config.log2_rows)
        at = [float(value) * cells + 0.5 for value in point]
        total = grid.new_zeros(config.features)
        for step in itertools.product((0, 1), repeat=3):
            corner = [int(a // 1) + s for a, s in zip(at, step, strict=True)]
            weight = 1.0
            for a, s in zip(at, step, strict=True):
                weight *= a % 1 if s else 1 - a % 1
            if per_axis**3 <= size:
                row = corner[0] + per_axis * corner[1] + per_axis**2 * corner[2]
            else:
                row = (corner[0] * PRIMES[0]) ^ (corner[1] * PRIMES[1]) ^ (corner[2] * PRIMES[2])
            total = total + weight * grid[first + row % size]
        features.append(total)
        first += size
    hidden = torch.cat(features)
    at = 0
    for i, (rows, columns) in enumerate(config.widths):
        hidden = network[at : at + rows * columns].reshape(rows, columns) @ hidden
        hidden = hidden.relu() if i < 2 else hidden
        at += rows * columns
    return hidden


def example(config: GridConfig) -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(3)
    grid = torch.randn(config.total_rows, config.features, generator=generator, dtype=torch.float64)
    network = torch.randn(config.weights, generator=generator, dtype=torch.float64) * 0.3
    points = torch.rand(25, 3, generator=generator, dtype=torch.float64)
    points[0], points[1], points[2] = 0.0, 1.0, torch.tensor([0.0, 1.0, 0.5])
    return grid.requires_grad_(), network.requires_grad_(), points


def test_outputs_and_gradients_are_those_of_the_definition() -> None:
    grid, network, points = example(SMALL)
    fast = transformation(Cache(grid, network), GridQuery.of(points, SMALL), SMALL)
    slow = torch.stack([naive(grid, network, point, SMALL) for point in points])
    torch.testing.assert_close(fast, slow)
    upstream = torch.randn(fast.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    torch.testing.assert_close(
        torch.autograd.grad(fast, [grid, network], upstream), torch.autograd.grad(slow, [grid, network], upstream)
    )


def test_both_kinds_of_level_are_there() -> None:
    dense = [SMALL.points(level) ** 3 <= SMALL.rows(level) for level in range(SMALL.levels)]
    assert dense == [True, True, False, False]


def test_weights_are_a_partition_of_one() -> None:
    _, _, points = example(SMALL)
    rows, weights = corners(points, SMALL)
    torch.testing.assert_close(weights.sum(1), torch.ones(len(weights), dtype=torch.float64))
    assert int(rows.min()) >= 0
    assert int(rows.max()) < SMALL.total_rows


def test_sizes_are_those_that_3dgstream_ships() -> None:
    config = GridConfig()
    assert config.total_rows == 16**3 + 15 * 2**15
    assert config.weights == 64 * 64 * 2 + 8 * 64


def test_a_linear_function_on_a_dense_level_is_interpolated_exactly() -> None:
    config = GridConfig(levels=1, features=1, log2_rows=12, base=8)
    index = torch.arange(8, dtype=torch.float64)
    grid = (index[:, None, None] * 100 + index[None, :, None] * 10 + index[None, None, :]).reshape(-1, 1)
    points = torch.rand(40, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 0.9
    query = GridQuery.of(points, config)
    found = (grid[query.rows.long()][:, :, 0] * query.weights).sum(1)
    at = points * 7 + 0.5
    torch.testing.assert_close(found, at @ torch.tensor([1.0, 10.0, 100.0], dtype=torch.float64))


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32])
def test_what_is_sent_is_what_is_computed_with(dtype: torch.dtype) -> None:
    cache = Cache.random(SMALL, torch.Generator().manual_seed(0)).as_stored()
    assert cache.grid.dtype == torch.float16
    again = Cache(cache.grid.to(dtype), cache.network.to(dtype)).as_stored()
    assert torch.equal(again.grid, cache.grid)
    assert cache.as_float().network.dtype == torch.float32

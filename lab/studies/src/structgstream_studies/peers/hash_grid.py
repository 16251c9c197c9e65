# SPDX-License-Identifier: Apache-2.0
"""A multi-resolution hash grid and a small fully-connected network: 3DGStream's transformation cache.

Note [Grid]
~~~~~~~~~~~
As Mueller et al. 2022 ("Instant neural graphics primitives"), with the conventions of their published code: level ``l``
has ``s = base * growth^l - 1`` cells and ``ceil(s) + 1`` points along each axis, a position ``x`` in the unit cube lies
at ``s x + 0.5``, and its features are interpolated trilinearly. A level whose points fit into the table has one row for
each (x fastest); in the others a point's row is the exclusive or of its coordinates times 1, 2654435761 and 805459861,
modulo the rows. The network has no biases.

Note [Rows asked for once]
~~~~~~~~~~~~~~~~~~~~~~~~~~
Positions are constant while a frame is fitted, so the rows and weights of the interpolation are computed once: the
lookup is a sparse matrix times the table, its gradient the transposed matrix times the incoming gradient. Both are
stored as bags of rows for ``embedding_bag``, whose own gradient takes twenty times as long on a CPU.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

PRIMES = (1, 2654435761, 805459861)


@dataclass(frozen=True)
class GridConfig:
    """Sizes of the cache: those that 3DGStream ships (``cache_F_4.json``)."""

    levels: int = 16
    features: int = 4
    log2_rows: int = 15
    """Binary logarithm of the most rows that a level has."""
    base: int = 16
    growth: float = 2.0
    hidden: int = 64
    outputs: int = 8
    """Shift 3, quaternion 4, one unused."""

    def cells(self, level: int) -> float:
        """Cells along each axis."""
        return self.base * self.growth**level - 1.0

    def points(self, level: int) -> int:
        """Grid points along each axis."""
        return math.ceil(self.cells(level)) + 1

    def rows(self, level: int) -> int:
        """Rows in the table: a multiple of eight, at most ``2 ** log2_rows``."""
        return min(-(-(self.points(level) ** 3) // 8) * 8, 2**self.log2_rows)

    @property
    def total_rows(self) -> int:
        """Rows of all levels together."""
        return sum(self.rows(level) for level in range(self.levels))

    @property
    def widths(self) -> tuple[tuple[int, int], ...]:
        """Rows and columns of each layer's weights, one after another in the network's vector."""
        return (self.hidden, self.levels * self.features), (self.hidden, self.hidden), (self.outputs, self.hidden)

    @property
    def weights(self) -> int:
        """Length of the network's vector."""
        return sum(rows * columns for rows, columns in self.widths)


@dataclass(frozen=True)
class Cache:
    """A grid ``[rows, features]`` and a network ``[weights]``: what is trained for each frame, and sent."""

    grid: Tensor
    network: Tensor

    @classmethod
    def random(cls, config: GridConfig, generator: torch.Generator) -> "Cache":
        """Features within 1e-4, each layer uniform within sqrt(6 / (inputs + outputs)) (the published code's start)."""
        grid = (torch.rand(config.total_rows, config.features, generator=generator) * 2 - 1) * 1e-4
        layers = [
            (torch.rand(rows * columns, generator=generator) * 2 - 1) * math.sqrt(6.0 / (rows + columns))
            for rows, columns in config.widths
        ]
        return cls(grid, torch.cat(layers))

    def tensors(self) -> dict[str, Tensor]:
        """Both by name."""
        return {"grid": self.grid, "network": self.network}

    @classmethod
    def of(cls, values: Mapping[str, Tensor]) -> "Cache":
        """The inverse of :meth:`tensors`."""
        return cls(values["grid"], values["network"])

    def as_stored(self) -> "Cache":
        """Rounded to float16: what is sent."""
        return Cache(self.grid.detach().half(), self.network.detach().half())

    def as_float(self) -> "Cache":
        """As float32, to compute with."""
        return Cache(self.grid.float(), self.network.float())


@dataclass(frozen=True)
class GridQuery:
    """Which rows ``n`` positions need (Note [Rows asked for once]).

    Args:
        rows: ``[n * levels, 8]`` rows of the grid.
        weights: ``[n * levels, 8]`` trilinear weights.
        back: for the transposed matrix: ``[nnz]`` rows of the output, ordered by row of the grid.
        back_starts: ``[total_rows]`` where each row's bag begins in ``back``.
        back_weights: ``[nnz]``.
    """

    rows: Tensor
    weights: Tensor
    back: Tensor
    back_starts: Tensor
    back_weights: Tensor

    @classmethod
    def of(cls, positions: Tensor, config: GridConfig, *, gradients: bool = True) -> "GridQuery":
        """The query of ``positions`` ``[n, 3]`` in the unit cube; the transposed part only with ``gradients``."""
        rows, weights = corners(positions, config)
        flat = rows.reshape(-1)
        if not gradients:
            none = flat[:0].to(torch.int32)
            return cls(rows.to(torch.int32), weights, none, none, weights.reshape(-1)[:0])
        order = flat.argsort(stable=True)
        counts = torch.bincount(flat, minlength=config.total_rows)
        index = torch.int32
        return cls(
            rows=rows.to(index),
            weights=weights,
            back=(order // 8).to(index),
            back_starts=(counts.cumsum(0) - counts).to(index),
            back_weights=weights.reshape(-1)[order],
        )


def corners(positions: Tensor, config: GridConfig) -> tuple[Tensor, Tensor]:
    """Rows and trilinear weights ``[n * levels, 8]`` of ``positions`` ``[n, 3]`` in the unit cube.

    Computed in double precision: the finest level has half a million cells along an axis.
    """
    n, device = positions.shape[0], positions.device
    steps = torch.tensor([[i & 1, i >> 1 & 1, i >> 2 & 1] for i in range(8)], device=device)
    rows = torch.empty(n, config.levels, 8, dtype=torch.int64, device=device)
    weights = torch.empty(n, config.levels, 8, dtype=positions.dtype, device=device)
    exact, first = positions.double(), 0
    for level in range(config.levels):
        points, size = config.points(level), config.rows(level)
        at = exact * config.cells(level) + 0.5
        low = at.floor()
        share = (at - low)[:, None, :]
        x, y, z = (low.long()[:, None, :] + steps).unbind(2)
        row = x + points * (y + points * z) if points**3 <= size else x * PRIMES[0] ^ y * PRIMES[1] ^ z * PRIMES[2]
        rows[:, level] = first + row % size
        weights[:, level] = torch.where(steps.bool(), share, 1.0 - share).prod(2)
        first += size
    return rows.reshape(-1, 8), weights.reshape(-1, 8)


def bags(table: Tensor, rows: Tensor, weights: Tensor, starts: Tensor | None = None) -> Tensor:
    """The weighted sum of the rows of each bag."""
    return torch.nn.functional.embedding_bag(rows, table, starts, mode="sum", per_sample_weights=weights)


class _Lookup(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, grid: Tensor, query: GridQuery) -> Tensor:
        ctx.query = query
        return bags(grid, query.rows, query.weights.to(grid))

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None]:
        query, grad = ctx.query, grads[0].contiguous()
        return bags(grad, query.back, query.back_weights.to(grad), query.back_starts), None


def transformation(cache: Cache, query: GridQuery, config: GridConfig) -> Tensor:
    """The network's outputs ``[n, outputs]`` at the query's positions; differentiable in the cache."""
    found: Tensor = _Lookup.apply(cache.grid, query)  # type: ignore[assignment]
    values = found.reshape(-1, config.levels * config.features)
    layers = cache.network.split([rows * columns for rows, columns in config.widths])
    for i, (layer, shape) in enumerate(zip(layers, config.widths, strict=True)):
        values = values @ layer.reshape(shape).T
        if i < len(layers) - 1:
            values = values.relu()
    return values

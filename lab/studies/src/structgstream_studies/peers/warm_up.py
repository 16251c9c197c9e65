# SPDX-License-Identifier: Apache-2.0
"""3DGStream's warm-up: a cache that leaves every position where it is, from which each frame starts."""

import math
from dataclasses import dataclass
from itertools import cycle

import torch
from torch import Tensor

from structgstream.kernels.backend import Backend
from structgstream.training.losses import Loss
from structgstream.training.optim import Adam, Hooks, Schedule, leaves, minimize
from structgstream.training.result import Stopwatch
from structgstream_studies.peers.hash_grid import Cache, GridConfig, GridQuery, transformation


@dataclass(frozen=True)
class WarmUpConfig:
    """How the first weights are found."""

    iterations: int = 3000
    rate: float = 1e-4
    noise: float = 0.01
    """Positions are also asked for up to this far away along each axis of the box."""
    batch: int = 2048
    """Positions of each kind in an iteration (3DGStream: all of them)."""
    batches: int = 16
    """Different batches, drawn once and taken in turn."""
    eps: float = 1e-8


def identity_loss(outputs: Tensor) -> Tensor:
    """How far ``[n, 8]`` outputs are from no motion: L1 of the shift, 1 - cos^2 of the turn, L1 of the unused to 1."""
    shifts, turns, unused = outputs.split((3, 4, 1), dim=1)
    cosines = turns[:, 0] / turns.norm(dim=1).clamp(min=1e-8)
    return shifts.abs().mean() + (1.0 - cosines.square().mean()) + (unused - 1.0).abs().mean()


def warm_up(
    positions: Tensor, *, config: WarmUpConfig, grid: GridConfig, backend: Backend, seed: int
) -> tuple[Cache, float]:
    """A cache that gives the identity in the unit cube, and its last loss.

    Args:
        positions: ``[n, 3]`` where there are Gaussians, in the unit cube.
        config: the schedule.
        grid: sizes of the cache.
        backend: what steps, and where.
        seed: all randomness comes from it.
    """
    generator, device = torch.Generator().manual_seed(seed), backend.device
    start = Cache.random(grid, generator)
    adam = Adam(backend, leaves({name: value.to(device) for name, value in start.tensors().items()}), config.eps)
    pool = [
        GridQuery.of(_batch(positions.cpu(), config, generator).to(device), grid)
        for _ in range(min(config.batches, config.iterations))
    ]
    hooks = _WarmUpHooks(adam, grid)
    rates = dict.fromkeys(adam.values, config.rate)
    minimize(adam, cycle(pool), Schedule(config.iterations, lambda _: rates), hooks, watch=Stopwatch())
    value = math.nan if hooks.last is None else float(hooks.last.total.detach())
    return Cache.of({name: leaf.detach() for name, leaf in adam.values.items()}), value


@dataclass
class _WarmUpHooks(Hooks[GridQuery, Loss]):
    """Batches of positions as samples; ``last`` is the last one's loss."""

    adam: Adam[str]
    grid: GridConfig
    last: Loss | None = None

    def loss(self, iteration: int, sample: GridQuery) -> Loss:
        total = identity_loss(transformation(Cache.of(self.adam.values), sample, self.grid))
        self.last = Loss(total, {"identity": total})
        return self.last


def _batch(positions: Tensor, config: WarmUpConfig, generator: torch.Generator) -> Tensor:
    """Positions of Gaussians, the same with noise, and uniform ones."""
    if not len(positions):
        return torch.rand(config.batch, 3, generator=generator)
    taken = positions[torch.randint(len(positions), (config.batch,), generator=generator)]
    noise = config.noise * torch.rand(taken.shape, generator=generator)
    return torch.cat([taken, (taken + noise).clamp(max=1.0), torch.rand(taken.shape, generator=generator)])

# SPDX-License-Identifier: Apache-2.0
"""Regularisation of frame 0 against overfitting to the training views: Gaussian dropout and random perturbation.

A rig sees a surface from few directions, so combinations of Gaussians can fit the training views and be wrong between
them. Dropping some Gaussians and perturbing the others in every iteration gives such combinations a large loss.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from structgstream.gaussians import Gaussians

TABLE_LENGTH = 1 << 21
"""Of a table of random numbers; it is a few times what an iteration reads."""


@dataclass(frozen=True)
class PerturbationConfig:
    """Dropout and perturbation while frame 0 is trained."""

    dropped_share: float = 0.0
    """Share of the Gaussians dropped in an iteration; the others' opacities are scaled up accordingly (paper: 0)."""
    noise_scales: float = 0.0
    """Standard deviation of normal noise on the means, in units of each Gaussian's own scale (paper: 0)."""
    until_share: float = 1.0
    """The two above decrease linearly to 0 at this share of the iterations."""
    view_noise: float = 0.0
    """Standard deviation, in rig radii, of normal noise on the camera centre that the MLPs' inputs use (paper: 0)."""
    view_noise_left: float = 1.0
    """Share of ``view_noise`` left at the last iteration, decreasing linearly; 1: constant."""


class RandomNumbers:
    """Random numbers that are read from random places of tables: to draw them anew takes a thirtieth of frame 0.

    Args:
        generator: of the tables and of the places.
        device: of the numbers.
        length: of a table. It grows where more are read at once.
    """

    def __init__(self, generator: torch.Generator, device: torch.device, *, length: int = TABLE_LENGTH) -> None:
        self._generator = generator
        self._device = device
        self._length = length
        self._tables: dict[str, Tensor] = {}

    def uniform(self, count: int) -> Tensor:
        """``[count]`` in [0, 1)."""
        return self._read("uniform", count)

    def normal(self, count: int) -> Tensor:
        """``[count, 3]`` of mean 0 and deviation 1."""
        return self._read("normal", 3 * count).reshape(count, 3)

    def _read(self, name: str, count: int) -> Tensor:
        table = self._tables.get(name)
        if table is None or len(table) < 2 * count:
            draw = torch.rand if name == "uniform" else torch.randn
            length = max(self._length, 2 * count)
            table = self._tables[name] = draw(length, generator=self._generator).to(self._device)
        first = int(torch.randint(len(table) - count + 1, (), generator=self._generator))
        return table[first : first + count]


class Perturbation:
    """Perturbs the Gaussians of one iteration.

    Args:
        config: amounts of dropout and noise.
        numbers: to perturb with.
        strength: factor on the amounts, 0 to 1.
    """

    def __init__(self, config: PerturbationConfig, numbers: RandomNumbers, *, strength: float) -> None:
        self._config = config
        self._numbers = numbers
        self._strength = strength

    def __call__(self, gaussians: Gaussians) -> Gaussians:
        dropped, noise = (self._strength * x for x in (self._config.dropped_share, self._config.noise_scales))
        opacities, means = gaussians.opacities, gaussians.means
        if dropped > 0.0:
            kept = (self._numbers.uniform(len(gaussians)) >= dropped).to(opacities)
            opacities = (opacities * kept / (1.0 - dropped)).clamp(max=0.999)
        if noise > 0.0:
            # Isotropic noise by the mean scale: following each Gaussian's rotation is not worth its cost.
            sizes = gaussians.scales.detach().mean(1, keepdim=True)
            means = means + noise * sizes * self._numbers.normal(len(gaussians)).to(means)
        return replace(gaussians, opacities=opacities, means=means)


def perturbed_center(
    center: Tensor,
    radius: float,
    iteration: int,
    iterations: int,
    config: PerturbationConfig,
    generator: torch.Generator,
) -> Tensor | None:
    """Perturbed origin ``[3]`` of the view direction in ``iteration`` of ``iterations``; None for the camera's centre.

    Only the MLPs' inputs are perturbed, not the projection. Appearance then varies slowly with the direction, so that
    it cannot be fitted to single training cameras.

    Args:
        center: of the camera, ``[3]``.
        radius: of the rig, scene units.
        iteration: from 1 on.
        iterations: of the fit.
        config: amounts of noise.
        generator: of the random numbers.
    """
    if not config.view_noise:
        return None
    left = 1.0 + (config.view_noise_left - 1.0) * iteration / max(1, iterations)
    return center + config.view_noise * left * radius * torch.randn(3, generator=generator).to(center)


def perturbation_at(
    iteration: int, iterations: int, config: PerturbationConfig, numbers: RandomNumbers
) -> Perturbation | None:
    """The perturbation of ``iteration`` of ``iterations``; None for none."""
    strength = 1.0 - iteration / max(1.0, iterations * config.until_share)
    if strength <= 0.0 or not (config.dropped_share or config.noise_scales):
        return None
    return Perturbation(config, numbers, strength=strength)

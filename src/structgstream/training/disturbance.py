# SPDX-License-Identifier: Apache-2.0
"""What keeps frame 0 from learning its few cameras by heart: in every iteration the scene is a little different.

Cameras of a ring see a surface from few sides. Gaussians that only look right together from exactly there are found
out when some are missing and none is quite where it was.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from structgstream.gaussians import Gaussians


@dataclass(frozen=True)
class DisturbanceConfig:
    """How much a scene is disturbed while frame 0 is fitted."""

    dropped_share: float = 0.0
    """So many of the Gaussians are left out of an iteration, and the rest made as much more opaque (paper: 0)."""
    noise_scales: float = 0.0
    """Means are shifted by normal noise of so many standard deviations of their Gaussian (paper: 0)."""
    until_share: float = 1.0
    """Disturbances fade out linearly until this share of the iterations."""


class Disturbance:
    """Disturbs the Gaussians of one iteration.

    Args:
        config: how much.
        generator: what is drawn comes from it.
        strength: 1 for all of it, 0 for nothing.
    """

    def __init__(self, config: DisturbanceConfig, generator: torch.Generator, *, strength: float) -> None:
        self._config = config
        self._generator = generator
        self._strength = strength

    def __call__(self, gaussians: Gaussians) -> Gaussians:
        dropped, noise = (self._strength * x for x in (self._config.dropped_share, self._config.noise_scales))
        opacities, means = gaussians.opacities, gaussians.means
        if dropped > 0.0:
            kept = (self._drawn(len(gaussians), opacities) >= dropped).to(opacities)
            opacities = (opacities * kept / (1.0 - dropped)).clamp(max=0.999)
        if noise > 0.0:
            shift = torch.randn(means.shape, generator=self._generator).to(means)
            # Along the axes of the scene, by the mean extent: it is noise, so no rotation is worth its cost.
            means = means + noise * gaussians.scales.detach().mean(1, keepdim=True) * shift
        return replace(gaussians, opacities=opacities, means=means)

    def _drawn(self, count: int, like: Tensor) -> Tensor:
        return torch.rand(count, generator=self._generator).to(like)


def disturbance_at(
    iteration: int, iterations: int, config: DisturbanceConfig, generator: torch.Generator
) -> Disturbance | None:
    """The disturbance of ``iteration`` of ``iterations``; None for none."""
    strength = 1.0 - iteration / max(1.0, iterations * config.until_share)
    if strength <= 0.0 or not (config.dropped_share or config.noise_scales):
        return None
    return Disturbance(config, generator, strength=strength)

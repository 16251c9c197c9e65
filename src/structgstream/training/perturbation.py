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
class PerturbationConfig:
    """How much a scene is disturbed while frame 0 is fitted."""

    dropped_share: float = 0.0
    """So many of the Gaussians are left out of an iteration, and the rest made as much more opaque (paper: 0)."""
    noise_scales: float = 0.0
    """Means are shifted by normal noise of so many standard deviations of their Gaussian (paper: 0)."""
    until_share: float = 1.0
    """These two fade out linearly until this share of the iterations."""
    view_noise: float = 0.0
    """Anchors look as from a place beside the camera: normal noise of so many rig radii (paper: 0)."""
    view_noise_left: float = 1.0
    """The share of it that is left, falling linearly, at the last iteration; 1: it stays the same."""


class Perturbation:
    """Disturbs the Gaussians of one iteration.

    Args:
        config: how much.
        generator: what is drawn comes from it.
        strength: 1 for all of it, 0 for nothing.
    """

    def __init__(self, config: PerturbationConfig, generator: torch.Generator, *, strength: float) -> None:
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


def perturbed_center(
    center: Tensor,
    radius: float,
    iteration: int,
    iterations: int,
    config: PerturbationConfig,
    generator: torch.Generator,
) -> Tensor | None:
    """From where the anchors are looked at in ``iteration`` of ``iterations``, ``[3]``; None for the camera itself.

    What the MLPs see of the camera is disturbed, not the projection: looks may then depend on the direction only as
    slowly as the noise is wide, and cannot tell one training camera from the next.

    Args:
        center: where the camera is, ``[3]``.
        radius: of the rig, scene units.
        iteration: from 1 on.
        iterations: of the fit.
        config: how much.
        generator: what is drawn comes from it.
    """
    if not config.view_noise:
        return None
    left = 1.0 + (config.view_noise_left - 1.0) * iteration / max(1, iterations)
    return center + config.view_noise * left * radius * torch.randn(3, generator=generator).to(center)


def perturbation_at(
    iteration: int, iterations: int, config: PerturbationConfig, generator: torch.Generator
) -> Perturbation | None:
    """The disturbance of ``iteration`` of ``iterations``; None for none."""
    strength = 1.0 - iteration / max(1.0, iterations * config.until_share)
    if strength <= 0.0 or not (config.dropped_share or config.noise_scales):
        return None
    return Perturbation(config, generator, strength=strength)

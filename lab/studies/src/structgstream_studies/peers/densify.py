# SPDX-License-Identifier: Apache-2.0
"""3DGS's adaptive density control: clones small Gaussians, splits large ones, prunes transparent ones."""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from structgstream_studies.peers.plain import PlainGaussians, rotated

SPLIT_INTO = 2
SPLIT_SHRINK = 0.8 * SPLIT_INTO
RESET_OPACITY = 0.01


@dataclass(frozen=True)
class DensifyConfig:
    """Schedule and thresholds of 3DGS's density control."""

    start: int = 500
    stop: int = 3000
    """Last iteration of densification (3DGS: 15,000 of 30,000)."""
    interval: int = 100
    gradient: float = 2e-4
    """Mean norm of the view-space gradient (NDC) above which a Gaussian is densified (3DGS: 2e-4)."""
    percent_dense: float = 0.01
    """Size, as a share of the extent (1.1 rig radii), below which a Gaussian is cloned and above which it is split."""
    min_opacity: float = 0.005
    max_extent: float = 0.1
    """Size, as a share of the extent, above which Gaussians are pruned after opacities have been reset."""
    reset_at: int | None = None
    """The one iteration after which opacities are cut to 0.01; None: never. 3DGS does it every 3,000 of 30,000; on a
    schedule of 4,000 it costs held-out quality (docs/peers.md)."""
    max_gaussians: int = 120_000
    """Largest number of Gaussians; candidates with the largest gradients are densified first (3DGS: no bound)."""

    def is_due(self, iteration: int) -> bool:
        """Whether the set changes after this iteration."""
        return self.start < iteration <= self.stop and iteration % self.interval == 0

    def has_reset(self, iteration: int) -> bool:
        """Whether opacities have been reset before this iteration."""
        return self.reset_at is not None and iteration > self.reset_at


@dataclass(frozen=True)
class Densification:
    """Rows to keep ``[N]``, Gaussians to append, and how many were removed for good."""

    keep: Tensor
    added: PlainGaussians
    removed: int


def reset_opacities(logits: Tensor) -> Tensor:
    """Opacities cut to at most 0.01, as logits."""
    return logits.detach().clamp(max=math.log(RESET_OPACITY / (1.0 - RESET_OPACITY)))


def split(parents: PlainGaussians, generator: torch.Generator) -> PlainGaussians:
    """Two smaller Gaussians for each parent, drawn from it."""
    copies = parents.select(torch.arange(len(parents), device=parents.means.device).repeat(SPLIT_INTO))
    noise = torch.randn(copies.means.shape, generator=generator).to(copies.means)
    return replace(
        copies,
        means=copies.means + rotated(copies.quats, noise * copies.log_scales.exp()),
        log_scales=copies.log_scales - math.log(SPLIT_SHRINK),
    )


def candidates(gradient: Tensor, *, threshold: float, room: int) -> Tensor:
    """Rows whose gradient ``[N]`` reaches the threshold, the ``room`` largest of them: a mask ``[N]``."""
    chosen = gradient >= threshold
    if int(chosen.sum()) > max(room, 0):
        best = gradient.argsort(descending=True, stable=True)[: max(room, 0)]
        chosen = torch.zeros_like(chosen)
        chosen[best] = True
    return chosen


def densify(
    gaussians: PlainGaussians,
    gradient: Tensor,
    *,
    config: DensifyConfig,
    extent: float,
    prune_large: bool,
    generator: torch.Generator,
) -> Densification:
    """One round of density control from the mean view-space gradients ``[N]``."""
    largest = gaussians.log_scales.exp().amax(1)
    chosen = candidates(gradient, threshold=config.gradient, room=config.max_gaussians - len(gaussians))
    large = largest > config.percent_dense * extent
    halves = split(gaussians.select(chosen & large), generator)
    added = gaussians.select(chosen & ~large).joined(halves)
    stays, new = (
        survivor_mask(gaussians, config, extent, prune_large),
        survivor_mask(added, config, extent, prune_large),
    )
    parents = chosen & large
    removed = int((~stays & ~parents).sum()) + int((~new).sum())
    return Densification(keep=stays & ~parents, added=added.select(new), removed=removed)


def survivor_mask(gaussians: PlainGaussians, config: DensifyConfig, extent: float, prune_large: bool) -> Tensor:
    """Rows that are opaque enough and, with ``prune_large``, not too large: a mask ``[N]``."""
    keep = gaussians.logit_opacities.sigmoid() >= config.min_opacity
    if prune_large:
        keep = keep & (gaussians.log_scales.exp().amax(1) <= config.max_extent * extent)
    return keep

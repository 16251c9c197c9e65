# SPDX-License-Identifier: Apache-2.0
"""Global patching with free Gaussians (paper, section Global Free 3DGs Patching Strategy)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Literal

import torch
from torch import Tensor

from structgstream.gaussians import Gaussians, concatenate
from structgstream.geometry import quaternion_matrices
from structgstream.kernels.backend import Backend
from structgstream.scene.free import FreeGaussians
from structgstream.scene.scene import Scene
from structgstream.training.views import View

BIRTHS_PER_FRAME = 1 << 32  # Birth ids are frame * 2^32 + n, so they never repeat and need no state between frames.


@dataclass(frozen=True)
class PatchingConfig:
    """Spawning and pruning of free Gaussians."""

    spawn: Literal["gradient", "random", "off"] = "gradient"
    """Choice of parents: ``gradient`` (paper), ``random`` (its ablation: as many, drawn at random), ``off``."""
    iteration: int = 50
    """Iteration after which patching is done, once per frame (paper: 50 of 100)."""
    grad_threshold: float = 1e-3
    """The paper's tau_grad (0.001), on the mean view-space gradient in NDC (Note [View-space units])."""
    collect_from: int = 0
    """Iteration of the frame after which gradients are averaged (paper: not stated)."""
    covariance_factor: float = 2.0
    """Factor on the covariance from which a child's mean is drawn, N(mu, factor * Sigma) (paper: 2)."""
    opacity: float = 0.1
    """Opacity at birth (paper: 0.1)."""
    prune_opacity: float | None = 0.005
    """Free Gaussians of less opacity are removed before spawning (paper: 0.005); None: no pruning, the paper's "w/o
    quantity control"."""
    lifetime: Literal["stream", "frame"] = "stream"
    """``stream``: inherited by the next frame (paper: global patching); ``frame``: dropped at its start (I1 to I3)."""
    max_free: int = 1_000_000
    """Largest number of free Gaussians; parents with the largest gradients are taken first (paper: no bound)."""


def survivor_mask(free: FreeGaussians, config: PatchingConfig) -> Tensor:
    """Mask ``[F]`` of the free Gaussians that are not pruned."""
    if config.prune_opacity is None:
        return torch.ones(len(free), dtype=torch.bool, device=free.means.device)
    return free.logit_opacities.sigmoid() >= config.prune_opacity


def choose_parents(
    mean_gradient: Tensor, count: Tensor, *, room: int, config: PatchingConfig, generator: torch.Generator
) -> Tensor:
    """Ids ``[P]`` that get a child, ascending.

    Args:
        mean_gradient: ``[slots]`` NDC.
        count: ``[slots]`` number of views that drew each Gaussian.
        room: largest number of parents.
        config: the rule.
        generator: for the random rule.
    """
    if config.spawn == "off" or room <= 0:
        return torch.zeros(0, dtype=torch.int64, device=count.device)
    chosen = ((mean_gradient > config.grad_threshold) & (count > 0)).nonzero()[:, 0]
    if config.spawn == "random":
        drawn = (count > 0).nonzero()[:, 0]
        pick = torch.randperm(drawn.numel(), generator=generator)[: chosen.numel()].to(drawn.device)
        chosen = drawn[pick]
    if chosen.numel() > room:
        chosen = chosen[mean_gradient[chosen].argsort(descending=True, stable=True)[:room]]
    return chosen.sort().values


def gaussians_by_id(scene: Scene, views: Sequence[View], ids: Tensor, backend: Backend) -> Gaussians:
    """The Gaussians ``ids``, ascending, each generated for the first of ``views`` that draws it.

    Structured Gaussians depend on the camera; a child copies colour and scale from a view in which its parent is drawn.
    Ids that no view draws (opacity 0) are left out.
    """
    found: list[Gaussians] = [_empty_like(scene)]
    slots = len(scene.anchors) * scene.anchors.offsets_per_anchor + len(scene.free)
    missing = torch.zeros(slots, dtype=torch.bool, device=ids.device)
    missing[ids] = True
    for view in views:
        if not missing.any():
            break
        seen = scene.gaussians(view.camera, backend)
        rows = (missing[seen.ids] & (seen.opacities > 0)).nonzero()[:, 0]
        found.append(replace(seen, sampling_intervals=None).select(rows))
        missing[seen.ids[rows]] = False
    together = reduce(concatenate, found)
    return together.select(together.ids.argsort())


def _empty_like(scene: Scene) -> Gaussians:
    none = scene.anchors.positions[:0]
    ids = torch.zeros(0, dtype=torch.int64, device=none.device)
    return Gaussians(none, none.new_zeros(0, 4), none, none.new_zeros(0), none, ids)


def spawn_children(
    parents: Gaussians, *, first_birth: int, config: PatchingConfig, generator: torch.Generator
) -> FreeGaussians:
    """One free Gaussian per parent, with its mean drawn from N(mu, factor * Sigma).

    With Sigma = R S S^T R^T a sample is mu + sqrt(factor) R S z with z standard normal. Colour and scale are the
    parent's, the rotation is the identity, the opacity ``config.opacity``. Births count from ``first_birth``.
    """
    count = len(parents)
    z = torch.randn(count, 3, generator=generator).to(parents.means)
    local = (config.covariance_factor**0.5) * parents.scales * z
    rotations = quaternion_matrices(parents.quats)
    unit = parents.means.new_tensor([1.0, 0.0, 0.0, 0.0])
    opacity = torch.tensor(config.opacity)
    return FreeGaussians(
        means=parents.means + (rotations @ local[:, :, None])[:, :, 0],
        log_scales=parents.scales.clamp(min=1e-9).log(),
        quats=unit.expand(count, 4).clone(),
        logit_opacities=torch.logit(opacity).to(parents.means).expand(count).clone(),
        colors=parents.colors.clone(),
        births=first_birth + torch.arange(count, device=parents.means.device),
    )

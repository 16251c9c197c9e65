# SPDX-License-Identifier: Apache-2.0
"""Pruning and spawning of free Gaussians by gradients (paper, section Global Free 3DGs Patching Strategy)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce

import torch
from torch import Tensor

from structgstream.gaussians import Gaussians, concatenate
from structgstream.geometry import quaternion_matrices
from structgstream.kernels.backend import Backend
from structgstream.scene.free import FreeGaussians
from structgstream.scene.scene import Scene
from structgstream.scene.state import ParameterName
from structgstream.training.losses import GradientStatistics
from structgstream.training.online.config import PatchingConfig
from structgstream.training.online.measure import slot_count
from structgstream.training.optim import Adam
from structgstream.training.parameters import FREE_ROWS, Parameters, values_of_rows
from structgstream.training.views import View

IDS_PER_FRAME = 1 << 32  # Birth ids are frame * 2^32 + n, so they never repeat and need no state between frames.


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
        generator: for the random rules.
    """
    if config.spawn == "off" or room <= 0:
        return torch.zeros(0, dtype=torch.int64, device=count.device)
    chosen = ((mean_gradient > config.grad_threshold) & (count > 0)).nonzero()[:, 0]
    if config.spawn in ("random", "uniform"):
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
    missing = torch.zeros(slot_count(scene), dtype=torch.bool, device=ids.device)
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
    parents: Gaussians, anchors: Tensor, *, first_identity: int, config: PatchingConfig, generator: torch.Generator
) -> FreeGaussians:
    """One free Gaussian per parent, with its mean drawn from N(mu, factor * Sigma).

    With Sigma = R S S^T R^T a sample is mu + sqrt(factor) R S z with z standard normal; by the rule ``uniform`` it is
    anywhere in the box around the positions ``anchors`` ``[M, 3]``. Colour and scale are the parent's, the rotation is
    the identity, the opacity ``config.OPACITY``. Identities count from ``first_identity``.
    """
    count = len(parents)
    if config.spawn == "uniform":
        low, high = anchors.aminmax(dim=0)
        means = low + (high - low) * torch.rand(count, 3, generator=generator).to(low)
    else:
        z = torch.randn(count, 3, generator=generator).to(parents.means)
        local = (config.COVARIANCE_FACTOR**0.5) * parents.scales * z
        means = parents.means + (quaternion_matrices(parents.quats) @ local[:, :, None])[:, :, 0]
    log_scales, colors = parents.scales.clamp(min=1e-9).log(), parents.colors.clone()
    return FreeGaussians.spawned(means, log_scales, colors, opacity=config.OPACITY, first_identity=first_identity)


def next_identity(births: Tensor, frame_index: int) -> int:
    """The first identity of a frame that is beyond all ``births``, of which some may be of this frame already."""
    first = frame_index * IDS_PER_FRAME
    return max(first, int(births.max()) + 1) if len(births) else first


@dataclass
class FreeSet:
    """The free Gaussians of one frame's fit, which it prunes and spawns.

    Args:
        config: the rule.
        template: of ``parameters``.
        parameters: of the frame.
        adam: of their values.
        statistics: view-space gradients by id.
        views: from which children may copy colour and scale.
        frame_index: of the frame, for identities of spawned Gaussians.
        room: largest number of free Gaussians.
        backend: the compute back-end.
        generator: of random numbers.
        spawned: number of spawned ones so far.
        pruned: number of pruned ones so far.
    """

    config: PatchingConfig
    template: Scene
    parameters: Parameters
    adam: Adam[ParameterName]
    statistics: GradientStatistics
    views: list[View]
    frame_index: int
    room: int
    backend: Backend
    generator: torch.Generator
    spawned: int = 0
    pruned: int = 0

    def __len__(self) -> int:
        return len(self.parameters.births)

    def patch(self, view: View) -> Tensor | None:
        """Prunes and spawns; returns the mask of the survivors, or None if none came or went.

        A child copies its parent's appearance in ``view``, if that draws it, else in the first other view that does.
        """
        current = self.parameters.scene(self.template)
        keep = survivor_mask(current.free, self.config)
        others = [other for other in self.views if other.index != view.index]
        parents = gaussians_by_id(current, [view, *others], self._parents(keep), self.backend)
        children = spawn_children(
            parents,
            current.anchors.positions,
            first_identity=next_identity(self.parameters.births, self.frame_index),
            config=self.config,
            generator=self.generator,
        )
        if keep.all() and not len(children):
            return None
        self.parameters.births = torch.cat([self.parameters.births[keep], children.births])
        self.adam.replace_rows(values_of_rows(children, FREE_ROWS), keep=keep)
        self.spawned, self.pruned = self.spawned + len(children), self.pruned + int((~keep).sum())
        return keep

    def _parents(self, keep: Tensor) -> Tensor:
        """Ids ``[P]`` that get a child when only those of the mask ``keep`` survive."""
        drawn = self.statistics.count.clone()
        drawn[len(drawn) - len(keep) :][~keep] = 0.0  # Pruned ones have no children.
        return choose_parents(
            self.statistics.mean(),
            drawn,
            room=self.room - int(keep.sum()),
            config=self.config,
            generator=self.generator,
        )

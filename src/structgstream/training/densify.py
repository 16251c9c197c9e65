# SPDX-License-Identifier: Apache-2.0
"""Applies growing and pruning of anchors to parameters, optimiser moments and statistics."""

from dataclasses import dataclass

import torch
from torch import Tensor

from structgstream.scene.anchors import AnchorCloud
from structgstream.scene.scene import Scene
from structgstream.scene.state import ParameterName
from structgstream.training.growth import GrowthConfig, OpacityStatistics, grow, prunable_mask
from structgstream.training.optim import Adam
from structgstream.training.parameters import ANCHOR_ROWS, values_of_rows
from structgstream.training.statistics import GradientStatistics


@dataclass
class Densifier:
    """Collects statistics of frame 0, and grows and prunes anchors by them.

    The clamp of the base scales is Scaffold-GS's: at most ``exp(0.05)`` scene units, whenever anchors are pruned.
    """

    config: GrowthConfig
    iterations: int
    voxel_size: float
    offsets_per_anchor: int
    seeds: int
    gradients: GradientStatistics
    opacities: OpacityStatistics
    grown: int = 0
    pruned: int = 0

    @classmethod
    def of(cls, scene: Scene, *, config: GrowthConfig, iterations: int, voxel_size: float) -> "Densifier":
        """Empty statistics for ``scene``, which is fitted in ``iterations`` iterations."""
        m, k = len(scene.anchors), scene.anchors.offsets_per_anchor
        device = scene.anchors.positions.device
        return cls(
            config, iterations, voxel_size, k, m, GradientStatistics(m * k, device), OpacityStatistics(m, device)
        )

    def collects(self, iteration: int) -> bool:
        """Whether statistics are collected at this iteration."""
        return self.config.collect_from < iteration <= self.config.last(self.iterations)

    def is_due(self, iteration: int) -> bool:
        """Whether anchors change after this iteration."""
        c = self.config
        return c.start < iteration <= c.last(self.iterations) and iteration % c.interval == 0

    def apply(
        self, scene: Scene, adam: Adam[ParameterName], generator: torch.Generator, *, iteration: int
    ) -> tuple[int, int]:
        """Grow, then prune, after ``iteration``; returns how many anchors were added and removed."""
        k = self.offsets_per_anchor
        new = grow(
            scene.anchors,
            mean_gradient=self.gradients.mean(),
            count=self.gradients.count,
            voxel_size=self.voxel_size,
            config=self.config,
            most=self.config.room_at(iteration, self.seeds),
            generator=generator,
        )
        eligible = self.gradients.count > self.config.eligible_count
        self.gradients.total[eligible] = 0.0
        self.gradients.count[eligible] = 0.0
        remove = prunable_mask(self.opacities, self.config)
        judged = self.opacities.visits > self.config.prune_visits
        self.opacities.opacity[judged] = 0.0
        self.opacities.visits[judged] = 0.0
        keep = ~remove
        log_cells = new.cell_sizes.log()[:, None].expand(-1, 3)
        anchors = AnchorCloud(
            new.positions, log_cells, log_cells, new.positions.new_zeros(len(new), k, 3), new.features
        )
        self._replace(adam, keep=keep, added=values_of_rows(anchors, ANCHOR_ROWS), count=len(new))
        adam.values["base_scales"].detach().clamp_(max=0.05)
        return len(new), int(remove.sum())

    def prunes_by_contribution(self, iteration: int) -> bool:
        """Whether anchors are pruned by contribution after this iteration."""
        return self.config.least_contribution > 0.0 and iteration in self.config.contribution_at

    def prune_by_contribution(self, contributions: Tensor, adam: Adam[ParameterName]) -> int:
        """Remove the anchors whose ``contributions`` ``[M]`` (relative to the mean) are too small; returns how many."""
        keep = contributions >= self.config.least_contribution
        self._replace(adam, keep=keep, added={}, count=0)
        return int((~keep).sum())

    def _replace(
        self, adam: Adam[ParameterName], *, keep: Tensor, added: dict[ParameterName, Tensor], count: int
    ) -> None:
        """Keep the rows of a mask ``[M]`` and append ``count`` rows, in all tensors with a row per anchor.

        New rows of parameters that are not in ``added`` are zero.
        """
        k = self.offsets_per_anchor
        new: dict[ParameterName, Tensor] = {}
        for name, old in adam.values.items():
            if name in ANCHOR_ROWS:
                new[name] = added[name] if name in added else old.detach().new_zeros(count, *old.shape[1:])
        adam.replace_rows(new, keep=keep)
        for statistics in (self.gradients, self.opacities):
            rows = keep.repeat_interleave(k) if statistics is self.gradients else keep
            more = count * k if statistics is self.gradients else count
            for name, values in vars(statistics).items():
                setattr(statistics, name, torch.cat([values[rows], values.new_zeros(more)]))
        self.grown, self.pruned = self.grown + count, self.pruned + int((~keep).sum())

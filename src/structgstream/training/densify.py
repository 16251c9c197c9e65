# SPDX-License-Identifier: Apache-2.0
"""Applying growth to everything that has a row for each anchor: parameters with their moments, and statistics."""

from dataclasses import dataclass

import torch
from torch import Tensor

from structgstream.scene.scene import Scene
from structgstream.training.growth import GrowthConfig, OpacityStatistics, grow, prunable
from structgstream.training.optim import Adam
from structgstream.training.parameters import ANCHOR_ROWS, ParameterName
from structgstream.training.statistics import GradientStatistics


@dataclass
class Densifier:
    """Statistics of frame 0 and the surgery they ask for.

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
        """Empty statistics for ``scene``, which is fitted in so many ``iterations``."""
        m, k = len(scene.anchors), scene.anchors.offsets_per_anchor
        device = scene.anchors.positions.device
        return cls(
            config, iterations, voxel_size, k, m, GradientStatistics(m * k, device), OpacityStatistics(m, device)
        )

    def collects(self, iteration: int) -> bool:
        """Whether statistics are wanted at this iteration."""
        return self.config.collect_from < iteration <= self.config.last(self.iterations)

    def due(self, iteration: int) -> bool:
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
        remove = prunable(self.opacities, self.config)
        judged = self.opacities.visits > self.config.prune_visits
        self.opacities.opacity[judged] = 0.0
        self.opacities.visits[judged] = 0.0
        keep = ~remove
        log_cells = new.cell_sizes.log()[:, None].expand(-1, 3)
        added: dict[ParameterName, Tensor] = {
            "anchor_positions": new.positions,
            "offset_scales": log_cells,
            "base_scales": log_cells,
            "anchor_offsets": new.positions.new_zeros(len(new), k, 3),
            "anchor_features": new.features,
            "appearance": new.positions.new_zeros(len(new), 0),
        }
        self._replace(adam, keep=keep, added=added)
        adam.values["base_scales"].detach().clamp_(max=0.05)
        return len(new), int(remove.sum())

    def judges(self, iteration: int) -> bool:
        """Whether contributions decide after this iteration who stays."""
        return self.config.least_contribution > 0.0 and iteration in self.config.contribution_at

    def judge(self, contributions: Tensor, adam: Adam[ParameterName]) -> int:
        """Remove the anchors whose ``contributions`` ``[M]`` (shares of the mean) are too small; tells how many."""
        keep = contributions >= self.config.least_contribution
        added: dict[ParameterName, Tensor] = {
            name: values.detach()[:0] for name, values in adam.values.items() if name in ANCHOR_ROWS
        }
        self._replace(adam, keep=keep, added=added)
        return int((~keep).sum())

    def _replace(self, adam: Adam[ParameterName], *, keep: Tensor, added: dict[ParameterName, Tensor]) -> None:
        """Keep the rows of a mask ``[M]`` and append ``added`` in everything that has a row for each anchor."""
        k, count = self.offsets_per_anchor, len(added["anchor_positions"])
        adam.replace_rows(added, keep=keep)
        for statistics in (self.gradients, self.opacities):
            rows = keep.repeat_interleave(k) if statistics is self.gradients else keep
            more = count * k if statistics is self.gradients else count
            for name, values in vars(statistics).items():
                setattr(statistics, name, torch.cat([values[rows], values.new_zeros(more)]))
        self.grown, self.pruned = self.grown + count, self.pruned + int((~keep).sum())

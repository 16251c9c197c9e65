# SPDX-License-Identifier: Apache-2.0
"""Applying growth to everything that has a row for each anchor: parameters, Adam state and statistics."""

from dataclasses import dataclass

import torch
from torch import Tensor

from structgstream.scene.scene import Scene
from structgstream.training.growth import GrowthConfig, OpacityStatistics, grow, prunable
from structgstream.training.optim import Adam
from structgstream.training.parameters import ANCHOR_ROWS, ParameterName, Parameters
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
    gradients: GradientStatistics
    opacities: OpacityStatistics
    grown: int = 0
    pruned: int = 0

    @classmethod
    def of(cls, scene: Scene, *, config: GrowthConfig, iterations: int, voxel_size: float) -> "Densifier":
        """Empty statistics for ``scene``, which is fitted in so many ``iterations``."""
        m, k = len(scene.anchors), scene.anchors.offsets_per_anchor
        device = scene.anchors.positions.device
        return cls(config, iterations, voxel_size, k, GradientStatistics(m * k, device), OpacityStatistics(m, device))

    def collects(self, iteration: int) -> bool:
        """Whether statistics are wanted at this iteration."""
        return self.config.collect_from < iteration <= self.config.last(self.iterations)

    def due(self, iteration: int) -> bool:
        """Whether anchors change after this iteration."""
        c = self.config
        return c.start < iteration <= c.last(self.iterations) and iteration % c.interval == 0

    def apply(self, scene: Scene, parameters: Parameters, adam: Adam, generator: torch.Generator) -> tuple[int, int]:
        """Grow, then prune; returns how many anchors were added and removed."""
        k = self.offsets_per_anchor
        new = grow(
            scene.anchors,
            mean_gradient=self.gradients.mean(),
            count=self.gradients.count,
            voxel_size=self.voxel_size,
            config=self.config,
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
        parameters.replace_rows(ANCHOR_ROWS, keep=keep, added=added)
        adam.replace_rows(ANCHOR_ROWS, keep=keep, added=len(new))
        parameters.values["base_scales"].detach().clamp_(max=0.05)
        for statistics in (self.gradients, self.opacities):
            rows = keep.repeat_interleave(k) if statistics is self.gradients else keep
            more = len(new) * k if statistics is self.gradients else len(new)
            for name, values in vars(statistics).items():
                setattr(statistics, name, torch.cat([values[rows], values.new_zeros(more)]))
        removed = int(remove.sum())
        self.grown, self.pruned = self.grown + len(new), self.pruned + removed
        return len(new), removed

# SPDX-License-Identifier: Apache-2.0
"""Growing and pruning anchors during frame 0, after Scaffold-GS (Lu et al., CVPR 2024)."""

from dataclasses import dataclass

import torch
from torch import Tensor

from structgstream.kernels.anchor_types import StructuredGaussians
from structgstream.scene.anchors import AnchorCloud


@dataclass(frozen=True)
class GrowthConfig:
    """When and where anchors are added and removed."""

    collect_from: int = 500
    """Statistics are collected after this iteration."""
    start: int = 1500
    """Anchors change after this iteration (paper: densification starts at 1500)."""
    stop: int = 15_000
    """Anchors change until this iteration."""
    interval: int = 100
    """Iterations between changes."""
    grad_threshold: float = 2e-4
    """Mean view-space gradient (NDC) from which a Gaussian asks for a coarse anchor; doubles with each level."""
    levels: int = 3
    """Cell sizes: 16, 4 and 1 voxels."""
    eligible_count: int = 40
    """A Gaussian is considered once it was drawn more often than this."""
    prune_visits: int = 80
    """An anchor is judged once it was visited more often than this."""
    prune_opacity: float = 0.005
    """An anchor goes when its opacity, summed over its Gaussians, averages less than this a visit."""
    max_anchors: int = 1_000_000
    """No anchor is added beyond this number."""


class OpacityStatistics:
    """Summed opacity and visits of each anchor."""

    def __init__(self, anchors: int, device: torch.device) -> None:
        self.opacity = torch.zeros(anchors, device=device)
        self.visits = torch.zeros(anchors, device=device)

    def add(self, structured: StructuredGaussians, visible: Tensor) -> None:
        """Add one rendering: the tanh outputs ``[m, K]`` of the visible anchors ``[m]``."""
        self.opacity[visible] += structured.raw_opacities.clamp(min=0.0).sum(1)
        self.visits[visible] += 1.0


@dataclass(frozen=True)
class NewAnchors:
    """Anchors to append: positions ``[A, 3]``, one cell size each ``[A]``, features ``[A, D]``."""

    positions: Tensor
    cell_sizes: Tensor
    features: Tensor

    def __len__(self) -> int:
        return self.positions.shape[0]


def cell_keys(points: Tensor, cell: float, origin: Tensor, extent: Tensor) -> Tensor:
    """One int64 for the cell of each point ``[P, 3]``; ``origin``, ``extent`` ``[3]`` int64 bound all cells."""
    cells = (points / cell).round().to(torch.int64) - origin
    return (cells[:, 0] * extent[1] + cells[:, 1]) * extent[2] + cells[:, 2]


def grow(
    anchors: AnchorCloud,
    *,
    mean_gradient: Tensor,
    count: Tensor,
    voxel_size: float,
    config: GrowthConfig,
    generator: torch.Generator,
) -> NewAnchors:
    """Propose anchors where Gaussians pull hard.

    Args:
        anchors: the present anchors, ``M`` with ``K`` Gaussians each.
        mean_gradient: ``[M * K]`` mean view-space gradient, NDC.
        count: ``[M * K]`` how often each Gaussian was drawn.
        voxel_size: the finest cell, scene units.
        config: thresholds.
        generator: for the random thinning.

    Three levels of cells (16, 4, 1 voxels); the finer ones only when a coarser one has added something in this call.
    A cell that already holds an anchor, old or proposed, is left alone.
    """
    k = anchors.offsets_per_anchor
    eligible = count > config.eligible_count
    means = (anchors.positions[:, None] + anchors.offsets * anchors.log_offset_scales.exp()[:, None]).reshape(-1, 3)
    added: list[NewAnchors] = []
    occupied = anchors.positions
    room = config.max_anchors - len(anchors)
    for level in range(config.levels):
        if level > 0 and not added:
            break
        thinned = torch.rand(means.shape[0], generator=generator).to(means.device) > 0.5 ** (level + 1)
        chosen = (eligible & (mean_gradient >= config.grad_threshold * 2**level) & thinned).nonzero()[:, 0]
        if chosen.numel() == 0 or room <= 0:
            continue
        cell = voxel_size * 16 / 4**level
        everything = (torch.cat([means[chosen], occupied]) / cell).round().to(torch.int64)
        origin = everything.amin(0)
        extent = everything.amax(0) - origin + 1
        keys = cell_keys(means[chosen], cell, origin, extent)
        fresh = ~torch.isin(keys, cell_keys(occupied, cell, origin, extent))
        unique, parent_cell = keys[fresh].unique(return_inverse=True)
        if unique.numel() == 0:
            continue
        parents = anchors.features[chosen[fresh] // k]
        features = parents.new_full((unique.numel(), parents.shape[1]), -torch.inf)
        features.scatter_reduce_(0, parent_cell[:, None].expand_as(parents), parents, reduce="amax")
        cells = torch.stack(
            [unique // (extent[1] * extent[2]), unique // extent[2] % extent[1], unique % extent[2]], dim=1
        )
        positions = (cells + origin).to(means) * cell
        positions, features = positions[:room], features[:room]
        room -= positions.shape[0]
        added.append(NewAnchors(positions, positions.new_full((positions.shape[0],), cell), features))
        occupied = torch.cat([occupied, positions])
    if not added:
        return NewAnchors(
            means.new_zeros(0, 3),
            means.new_zeros(0),
            anchors.features.new_zeros(0, anchors.features.shape[1]),
        )
    return NewAnchors(
        torch.cat([new.positions for new in added]),
        torch.cat([new.cell_sizes for new in added]),
        torch.cat([new.features for new in added]),
    )


def prunable(statistics: OpacityStatistics, config: GrowthConfig) -> Tensor:
    """Mask ``[M]`` of anchors that were looked at often enough and are as good as transparent."""
    judged = statistics.visits > config.prune_visits
    return judged & (statistics.opacity < config.prune_opacity * statistics.visits)

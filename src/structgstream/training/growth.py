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
    """Anchors change until this iteration, and never within the last ``interval`` of a fit (:meth:`last`)."""
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
    least_contribution: float = 0.0
    """At ``contribution_at`` an anchor goes that contributes less to the training pictures than this share of what an
    average anchor does (Scaffold-GS: 0, none)."""
    contribution_at: tuple[int, ...] = ()
    """The iterations after which contributions are looked at."""
    max_anchors: int = 1_000_000
    """No anchor is added beyond this number; those with the largest gradients come first."""
    least_growth: float = 0.0
    """There is room for this share of the seeds on top of them, even beyond ``max_anchors``: a capture with many points
    grows, too."""
    room_until: int = 0
    """Their number may rise evenly from ``start`` to this iteration; 0: there is room for all from the beginning."""

    def room_at(self, iteration: int, seeds: int) -> int:
        """How many anchors there may be after ``iteration``, when there were ``seeds`` at first.

        Few at first cost little while pictures are still coarse, and what comes late comes where it is missed most.
        """
        most = self.max_anchors
        if self.least_growth:
            most = max(most, seeds + round(self.least_growth * seeds))
        if iteration >= self.room_until:
            return most
        share = max(0.0, (iteration - self.start) / (self.room_until - self.start))
        return min(most, seeds + round(share * max(0, most - seeds)))

    def last(self, iterations: int) -> int:
        """The iteration after which anchors no longer change, in a fit of ``iterations``.

        What is added must be fitted too: a whole interval is left for that. Scaffold-GS, which stops growing half way
        through its 30,000 iterations, never meets this; the paper ends at 4,000, in the midst of the growing.
        """
        return min(self.stop, iterations - self.interval)


class OpacityStatistics:
    """Summed opacity and visits of each anchor."""

    def __init__(self, anchors: int, device: torch.device) -> None:
        self.opacity = torch.zeros(anchors, device=device)
        self.visits = torch.zeros(anchors, device=device)

    def add(self, structured: StructuredGaussians) -> None:
        """Add one rendering."""
        self.opacity[structured.anchors] += structured.raw_opacities.clamp(min=0.0).sum(1)
        self.visits[structured.anchors] += 1.0


@dataclass(frozen=True)
class NewAnchors:
    """Anchors to append: positions ``[A, 3]``, one cell size each ``[A]``, features ``[A, D]``.

    ``strengths`` ``[A]`` are the largest mean gradients that asked for them, in thresholds of their level.
    """

    positions: Tensor
    cell_sizes: Tensor
    features: Tensor
    strengths: Tensor

    def __len__(self) -> int:
        return self.positions.shape[0]

    def strongest(self, count: int) -> "NewAnchors":
        """At most ``count`` of them, in their order; of equals the first."""
        if len(self) <= count:
            return self
        rows = self.strengths.argsort(descending=True, stable=True)[: max(count, 0)].sort().values
        return NewAnchors(self.positions[rows], self.cell_sizes[rows], self.features[rows], self.strengths[rows])


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
    most: int,
    generator: torch.Generator,
) -> NewAnchors:
    """Propose anchors where Gaussians pull hard.

    Args:
        anchors: the present anchors, ``M`` with ``K`` Gaussians each.
        mean_gradient: ``[M * K]`` mean view-space gradient, NDC.
        count: ``[M * K]`` how often each Gaussian was drawn.
        voxel_size: the finest cell, scene units.
        config: thresholds.
        most: at most so many anchors in the end, present ones counted.
        generator: for the random thinning.

    Three levels of cells (16, 4, 1 voxels); the finer ones only when a coarser one has added something in this call.
    A cell that already holds an anchor, old or proposed, is left alone. Where there is not room for all, those stay
    whose gradients exceed their level's threshold most.
    """
    k = anchors.offsets_per_anchor
    eligible = count > config.eligible_count
    means = (anchors.positions[:, None] + anchors.offsets * anchors.log_offset_scales.exp()[:, None]).reshape(-1, 3)
    added: list[NewAnchors] = []
    occupied = anchors.positions
    for level in range(config.levels):
        if level > 0 and not added:
            break
        every_nth_frame = torch.rand(means.shape[0], generator=generator).to(means.device) > 0.5 ** (level + 1)
        threshold = config.grad_threshold * 2**level
        chosen = (eligible & (mean_gradient >= threshold) & every_nth_frame).nonzero()[:, 0]
        if chosen.numel() == 0:
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
        strengths = mean_gradient.new_zeros(unique.numel())
        strengths.scatter_reduce_(0, parent_cell, mean_gradient[chosen[fresh]] / threshold, reduce="amax")
        cells = torch.stack(
            [unique // (extent[1] * extent[2]), unique // extent[2] % extent[1], unique % extent[2]], dim=1
        )
        positions = (cells + origin).to(means) * cell
        added.append(NewAnchors(positions, positions.new_full((positions.shape[0],), cell), features, strengths))
        occupied = torch.cat([occupied, positions])
    if not added:
        return NewAnchors(
            means.new_zeros(0, 3),
            means.new_zeros(0),
            anchors.features.new_zeros(0, anchors.features.shape[1]),
            means.new_zeros(0),
        )
    return NewAnchors(
        torch.cat([new.positions for new in added]),
        torch.cat([new.cell_sizes for new in added]),
        torch.cat([new.features for new in added]),
        torch.cat([new.strengths for new in added]),
    ).strongest(most - len(anchors))


def prunable_mask(statistics: OpacityStatistics, config: GrowthConfig) -> Tensor:
    """Mask ``[M]`` of anchors that were looked at often enough and are as good as transparent."""
    judged = statistics.visits > config.prune_visits
    return judged & (statistics.opacity < config.prune_opacity * statistics.visits)

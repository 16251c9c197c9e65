# SPDX-License-Identifier: Apache-2.0
"""Growing and pruning of anchors in frame 0, after Scaffold-GS (Lu et al., CVPR 2024)."""

from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from structgstream.kernels.values import StructuredGaussians
from structgstream.scene.anchors import AnchorCloud
from structgstream.scene.scene import Scene
from structgstream.scene.state import ParameterName
from structgstream.training.losses import GradientStatistics
from structgstream.training.optim import Adam
from structgstream.training.parameters import ANCHOR_ROWS, values_of_rows

MAX_ANCHORS = 400_000
"""Bound of what larger pictures may have: about 1 GB of memory while frame 0 is trained."""


@dataclass(frozen=True)
class GrowthConfig:
    """Schedule and thresholds of growing and pruning anchors in frame 0."""

    collect_from: int = 500
    """Statistics are collected after this iteration."""
    start: int = 1500
    """Anchors are grown and pruned after this iteration (paper: 1500)."""
    stop: int = 15_000
    """Anchors are grown and pruned until this iteration, and not within the last ``interval`` of a fit (:meth:`last`;
    Scaffold-GS: 15,000)."""
    interval: int = 100
    """Iterations between growing and pruning (Scaffold-GS: 100)."""
    grad_threshold: float = 2e-4
    """Mean view-space gradient (NDC) above which a Gaussian proposes an anchor at the coarsest level; doubles with each
    finer level (Scaffold-GS: 2e-4)."""
    eligible_count: int = 40
    """A Gaussian proposes anchors only once it was drawn more often than this; then its statistics begin again."""
    prune_visits: int = 80
    """An anchor can be pruned by opacity once it was in view more often than this."""
    max_anchors: int = 1_000_000
    """Largest number of anchors for pictures of the reference size (:meth:`for_pictures`); proposals with the largest
    gradients are taken first (paper: no bound)."""
    min_growth: float = 0.0
    """At least this share of the number of seeds may be added, even beyond ``max_anchors``."""
    room_until: int = 0
    """The allowed number of anchors rises linearly from ``start`` to this iteration; 0: all are allowed at once."""

    LEVELS: ClassVar[int] = 3
    """Number of cell sizes, 16, 4 and 1 voxels (Scaffold-GS: 3)."""
    PRUNE_OPACITY: ClassVar[float] = 0.005
    """An anchor is pruned if the sum of its Gaussians' opacities is below this on average over the views."""

    def for_pictures(self, enlarged: float) -> "GrowthConfig":
        """The same for pictures whose sides are ``enlarged`` times those of the reference size (``View.enlargement``).

        Their detail has as many times the anchors: in proportion to the pictures' sides, since edges and not areas have
        most of it, and at most :data:`MAX_ANCHORS` (lab/notes/scaling.md).
        """
        most = min(round(self.max_anchors * enlarged), MAX_ANCHORS)
        return replace(self, max_anchors=max(self.max_anchors, most))

    def room_at(self, iteration: int, seeds: int) -> int:
        """Allowed number of anchors after ``iteration``, with ``seeds`` initial ones.

        Few anchors are cheap while the pictures are coarse, and late ones are placed where gradients are still large.
        """
        most = self.max_anchors
        if self.min_growth:
            most = max(most, seeds + round(self.min_growth * seeds))
        if iteration >= self.room_until:
            return most
        share = max(0.0, (iteration - self.start) / (self.room_until - self.start))
        return min(most, seeds + round(share * max(0, most - seeds)))

    def last(self, iterations: int) -> int:
        """The last iteration after which anchors are grown or pruned, in a fit of ``iterations``.

        One interval is left to train the last added anchors. This does not affect Scaffold-GS, which stops growing half
        way through its 30,000 iterations, but the paper, whose 4,000 iterations end during the growing.
        """
        return min(self.stop, iterations - self.interval)


class OpacityStatistics:
    """Sum of opacities, and number of views, of each anchor."""

    def __init__(self, anchors: int, device: torch.device) -> None:
        self.opacity = torch.zeros(anchors, device=device)
        self.visits = torch.zeros(anchors, device=device)

    def add(self, structured: StructuredGaussians) -> None:
        """Add one rendering."""
        opacities = structured.raw_opacities.clamp(min=0.0).sum(1)
        self.opacity.scatter_add_(0, structured.anchors, opacities)
        self.visits.scatter_add_(0, structured.anchors, torch.ones_like(opacities))


@dataclass(frozen=True)
class NewAnchors:
    """Anchors to append: positions ``[A, 3]``, one cell size each ``[A]``, features ``[A, D]``.

    ``strengths`` ``[A]`` are the largest mean gradients of the proposing Gaussians, in units of the level's threshold.
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
        return NewAnchors(**{name: column[rows] for name, column in vars(self).items()})


def fresh_cells(points: Tensor, occupied: Tensor, cell: float) -> tuple[Tensor, Tensor, Tensor]:
    """The cells of side ``cell`` that hold some of ``points`` ``[P, 3]`` and none of ``occupied``, ascending.

    Returns:
        Mask ``[P]`` of the points in such cells, the cell ``[p]`` of each of these, and the cells ``[C, 3]`` int64 in
        units of their side.
    """
    cells = (torch.cat([points, occupied]) / cell).round().to(torch.int64)
    origin = cells.amin(0)
    x, y, z = (cells - origin).unbind(1)
    _, rows, columns = (cells.amax(0) - origin + 1).unbind()
    keys, others = ((x * rows + y) * columns + z).split([len(points), len(occupied)])
    fresh = ~torch.isin(keys, others)
    unique, index = keys[fresh].unique(return_inverse=True)
    found = torch.stack([unique // (rows * columns), unique // columns % rows, unique % columns], dim=1)
    return fresh, index, found + origin


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
    """Propose anchors where view-space gradients are large.

    Args:
        anchors: the present anchors, ``M`` with ``K`` Gaussians each.
        mean_gradient: ``[M * K]`` mean view-space gradient, NDC.
        count: ``[M * K]`` number of views that drew each Gaussian.
        voxel_size: the finest cell, scene units.
        config: thresholds.
        most: largest number of anchors, including the present ones.
        generator: for the random thinning.

    Three levels of cells (16, 4, 1 voxels); finer levels only if a coarser one has added anchors in this call. Cells
    with an anchor, present or proposed, get none. If ``most`` is exceeded, the proposals with the largest ratio of
    gradient to threshold are taken.
    """
    eligible = count > config.eligible_count
    means = (anchors.positions[:, None] + anchors.offsets * anchors.log_offset_scales.exp()[:, None]).reshape(-1, 3)
    added: list[NewAnchors] = []
    occupied = anchors.positions
    for level in range(config.LEVELS):
        if level > 0 and not added:
            break
        sampled = torch.rand(means.shape[0], generator=generator).to(means.device) > 0.5 ** (level + 1)
        threshold = config.grad_threshold * 2**level
        chosen = (eligible & (mean_gradient >= threshold) & sampled).nonzero()[:, 0]
        if chosen.numel() == 0:
            continue
        new = _new_cells(
            means[chosen],
            anchors.features[chosen // anchors.offsets_per_anchor],
            mean_gradient[chosen] / threshold,
            occupied=occupied,
            cell=voxel_size * 16 / 4**level,
        )
        if len(new):
            added.append(new)
            occupied = torch.cat([occupied, new.positions])
    if not added:
        none = means.new_zeros(0)
        return NewAnchors(means[:0], none, anchors.features[:0], none)
    together = {name: torch.cat([getattr(new, name) for new in added]) for name in vars(added[0])}
    return NewAnchors(**together).strongest(most - len(anchors))


def _new_cells(means: Tensor, features: Tensor, strengths: Tensor, *, occupied: Tensor, cell: float) -> NewAnchors:
    """One anchor for each cell of side ``cell`` that holds some of ``means`` ``[n, 3]`` and none of ``occupied``.

    It gets the largest of their ``features`` ``[n, D]``, column by column, and of their ``strengths`` ``[n]``.
    """
    fresh, index, cells = fresh_cells(means, occupied, cell)
    parents, count = features[fresh], len(cells)
    largest = parents.new_full((count, parents.shape[1]), -torch.inf)
    largest.scatter_reduce_(0, index[:, None].expand_as(parents), parents, reduce="amax")
    strongest = strengths.new_zeros(count).scatter_reduce_(0, index, strengths[fresh], reduce="amax")
    positions = cells.to(means) * cell
    return NewAnchors(positions, positions.new_full((count,), cell), largest, strongest)


def prunable_mask(statistics: OpacityStatistics, config: GrowthConfig) -> Tensor:
    """Mask ``[M]`` of the anchors that were in view often enough and are nearly transparent."""
    judged = statistics.visits > config.prune_visits
    return judged & (statistics.opacity < config.PRUNE_OPACITY * statistics.visits)


@dataclass
class Densifier:
    """Collects statistics of frame 0, and grows and prunes anchors by them.

    The clamp of the base scales is Scaffold-GS's: at most ``exp(0.05)`` scene units, whenever anchors are pruned.
    """

    config: GrowthConfig
    iterations: int
    voxel_size: float
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
        return cls(config, iterations, voxel_size, m, GradientStatistics(m * k, device), OpacityStatistics(m, device))

    def collects(self, iteration: int) -> bool:
        """Whether statistics are collected at this iteration."""
        return self.config.collect_from < iteration <= self.config.last(self.iterations)

    def is_due(self, iteration: int) -> bool:
        """Whether anchors change after this iteration."""
        c = self.config
        return c.start < iteration <= c.last(self.iterations) and iteration % c.interval == 0

    def apply(self, scene: Scene, adam: Adam[ParameterName], generator: torch.Generator, *, iteration: int) -> None:
        """Grow, then prune, after ``iteration``."""
        k = scene.anchors.offsets_per_anchor
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
        keep = ~prunable_mask(self.opacities, self.config)
        judged = self.opacities.visits > self.config.prune_visits
        self.opacities.opacity[judged] = 0.0
        self.opacities.visits[judged] = 0.0
        log_cells = new.cell_sizes.log()[:, None].expand(-1, 3)
        anchors = AnchorCloud(
            new.positions, log_cells, log_cells, new.positions.new_zeros(len(new), k, 3), new.features
        )
        adam.replace_rows(values_of_rows(anchors, ANCHOR_ROWS), keep=keep)
        adam.values["base_scales"].detach().clamp_(max=0.05)
        for statistics, per_anchor in ((self.gradients, k), (self.opacities, 1)):
            rows = keep.repeat_interleave(per_anchor)
            for name, values in vars(statistics).items():
                setattr(statistics, name, torch.cat([values[rows], values.new_zeros(per_anchor * len(new))]))
        self.grown, self.pruned = self.grown + len(new), self.pruned + int((~keep).sum())

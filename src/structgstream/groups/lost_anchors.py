# SPDX-License-Identifier: Apache-2.0
"""Relocation of anchors that tracking lost before a group's first frame.

An anchor that covers few pixels at the rim of a body may get no vote in some frames. It then remains as a speck on the
background, where nothing changes any more. Iterations cannot recover it, because it is too far away. A lost anchor
therefore gets the displacement of its neighbours in frame 0 with similar features; iterations refine it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from structgstream.kernels.backend import Backend
from structgstream.scene.active_tiles import ActiveTiles
from structgstream.scene.anchors import AnchorCloud
from structgstream.scene.scene import Scene
from structgstream.training.neighbours import nearest
from structgstream.training.online.config import SpawnRules
from structgstream.training.online.measure import accumulate, primitive_of, sum_by_primitive
from structgstream.training.online.spawn import outlier_mask, view_residual
from structgstream.training.parameters import pixel_size
from structgstream.training.residuals import ResidualFloor
from structgstream.training.views import View

MEDIAN_STEPS = 12


@dataclass(frozen=True)
class LostAnchorConfig:
    """Relocation of lost anchors by the displacements of their neighbours; not in the paper."""

    enabled: bool = True
    neighbours: int = 32
    """Number of nearest inlier anchors of frame 0 whose displacements are used."""
    feature_bandwidth: float = 0.5
    """A neighbour's weight is a Gaussian of the root mean square difference of features; this is its standard
    deviation, in standard deviations of the features."""
    min_pixels: float = 3.0
    """Anchors that would move by no more pixels than this are not relocated."""


def relocate_lost_anchors(
    dynamic: Scene,
    first: AnchorCloud,
    views: Sequence[View],
    active_tiles: Mapping[int, ActiveTiles],
    *,
    floor: ResidualFloor | None,
    min_pixels: float,
    births: SpawnRules,
    config: LostAnchorConfig,
    backend: Backend,
) -> tuple[Scene, int]:
    """``dynamic`` with its lost anchors moved to their neighbours, and the number of lost anchors.

    Args:
        dynamic: the dynamic part of a scene.
        first: its anchors in frame 0, in the same order.
        views: views of the frame.
        active_tiles: by view index, with up-to-date renderings; views without an entry are skipped.
        floor: baseline residuals of frame 0; None for none.
        min_pixels: views in which an anchor covers fewer pixels do not count.
        births: thresholds of the outlier test.
        config: configuration of the relocation.
        backend: the compute back-end.

    Raises:
        MissingExtraError: SciPy is not installed.
    """
    pixel = pixel_size(first.positions, [view.camera for view in views])
    if not config.enabled or pixel is None or len(first) < 2:
        return dynamic, 0
    with torch.no_grad():
        outliers = _outlier_anchors(dynamic, views, active_tiles, floor, min_pixels, births, backend)
        if not outliers.any() or outliers.all():
            return dynamic, 0
        positions = dynamic.anchors.positions
        displacements = positions - first.positions
        rows = outliers.nonzero()[:, 0]
        expected = _displacements_of_neighbours(first, displacements, rows, ~outliers, config)
        far = (expected - displacements[rows]).norm(dim=1) > config.min_pixels * pixel
        rows, expected = rows[far], expected[far]
        positions = positions.index_copy(0, rows, first.positions[rows] + expected)
    return replace(dynamic, anchors=replace(dynamic.anchors, positions=positions)), len(rows)


def _outlier_anchors(
    dynamic: Scene,
    views: Sequence[View],
    active_tiles: Mapping[int, ActiveTiles],
    floor: ResidualFloor | None,
    min_pixels: float,
    births: SpawnRules,
    backend: Backend,
) -> Tensor:
    """Mask ``[M]`` of the anchors that are outliers in several views (``births.outlier_mask``)."""
    folded, coverage, wrong = dynamic.with_folded_appearance(), [], []
    for view in views:
        active = active_tiles.get(view.index)
        if active is None:
            continue
        found = view_residual(active.picture, view, dynamic.camera_color, floor=floor, rules=births, backend=backend)
        small = found.view
        pixels = found.wrong.to(active.picture)
        counting = torch.ones_like(pixels) if small.mask is None else small.mask.to(pixels)
        gaussians = folded.gaussians(small.camera, backend)
        maps = torch.stack([counting, pixels], dim=-1)
        of_gaussians = accumulate(gaussians, small.camera, maps, backend, static=active.static)
        sums = sum_by_primitive(of_gaussians, primitive_of(gaussians, folded), folded)
        coverage.append(sums[: len(dynamic.anchors), 0])
        wrong.append(sums[: len(dynamic.anchors), 1])
    if not coverage:
        return torch.zeros(len(dynamic.anchors), dtype=torch.bool, device=dynamic.anchors.positions.device)
    return outlier_mask(torch.stack(coverage), torch.stack(wrong), min_pixels=min_pixels, rules=births)


def _displacements_of_neighbours(
    first: AnchorCloud, displacements: Tensor, rows: Tensor, inliers: Tensor, config: LostAnchorConfig
) -> Tensor:
    """Weighted geometric median ``[R, 3]`` of the displacements of the neighbours of ``rows`` in frame 0.

    Neighbours are chosen from the mask ``inliers``. Unlike a mean, the median ignores a few neighbours on another body.
    """
    among = inliers.nonzero()[:, 0]
    near, _ = nearest(first.positions[rows], first.positions[among], config.neighbours)
    near = among[near]
    features = first.features.detach()
    features = features / features.std(0).clamp(min=1e-6)
    differences = (features[near] - features[rows][:, None]).square().mean(-1)
    weights = torch.exp(-0.5 * differences / config.feature_bandwidth**2).clamp(min=1e-12)
    values = displacements[near]
    median = (weights[..., None] * values).sum(1) / weights.sum(1, keepdim=True)
    for _ in range(MEDIAN_STEPS):  # Weiszfeld
        shares = weights / (values - median[:, None]).norm(dim=-1).clamp(min=1e-6)
        median = (shares[..., None] * values).sum(1) / shares.sum(1, keepdim=True)
    return median

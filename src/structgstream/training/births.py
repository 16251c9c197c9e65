# SPDX-License-Identifier: Apache-2.0
"""Births of free Gaussians from multi-view geometry before the first iteration, and removal of wrong ones.

Spawning by gradients places a faint child beside a parent, which then needs frames to converge. Where pixels of several
views still have a large residual after the motion start, new content is located directly by a plane sweep: along the
ray of such a pixel, in front of the rendered depth, at the depth where other views have the same missing colour.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from structgstream.errors import MissingExtraError
from structgstream.kernels.backend import Backend
from structgstream.kernels.values import SweepView, TileSelection
from structgstream.scene.color import CameraColor
from structgstream.scene.free import FreeGaussians
from structgstream.training.residuals import ResidualFloor, box_mean
from structgstream.training.views import View

MASK_PIXELS = 5
HIT_VOXELS = 1.8
COARSEST = 8.0
"""Births are coarser than the swept rays by at most about this."""
CLUSTER_VOXELS = 2.0
"""Births nearer to each other than this belong to one cluster."""


@dataclass(frozen=True)
class ThinBirthConfig:
    """A second sweep, for thin and faint content such as a stream of water, in frames in which the first bears nothing.

    Its fields replace those of the same names of :class:`BirthConfig`: finer pictures, every ray, lower thresholds. By
    these rules something large would be born of many small Gaussians, which follow it worse than few large ones do and
    cost more.
    """

    enabled: bool = False
    picture_width: int = 480
    missing_threshold: float = 0.04
    pixel_step: int = 1
    most_contradictions: float = 0.5
    most_cost: float = 0.2
    least_hits: int = 3
    most: int = 150
    crowded: Literal["coarser", "none", "small-clusters"] = "none"
    """Thin content is little. Where more would be born, what moves is not where it should be, as in a throw: births in
    its place follow it worse and cost more than what they stand for. A group of frames that is fitted apart lacks what
    the frames before it would have borne: its first frames bear what lies in small clusters."""
    most_missing_share: float = 0.02
    """Of the pictures 0.0005 lack something where a pitcher pours. More is light that changed."""


@dataclass(frozen=True)
class BirthConfig:
    """Births of free Gaussians from geometry, and removal by residuals; not in the paper."""

    enabled: bool = False
    """Paper: False, free Gaussians are spawned by gradients only."""
    picture_width: int = 320
    """Pictures are reduced to at most this width, pixels."""
    residual_threshold: float = 0.10
    """Residual, 0 to 1, above which a pixel counts as wrong."""
    missing_threshold: float = 0.10
    """Excess of the residual over frame 0's, 0 to 1, above which a pixel counts as missing."""
    changed_floor_medians: float | None = None
    """Where a picture has changed, frame 0's residual, which was of other content, counts as at most this many medians
    of its view's. None: all of it counts, as it does in the sweep for thin content."""
    pixel_step: int = 2
    """Distance in pixels, across and down, between missing pixels whose rays are swept."""
    planes: int = 48
    least_supports: int = 2
    """Least number of other views that support a point: there a missing pixel lies at its projection."""
    most_contradictions: float = 0.34
    """Largest share of contradicting views, which would see the point but miss nothing, among those that can judge."""
    most_cost: float = 0.12
    least_hits: int = 4
    """Least number of ray points within 1.8 voxels for a birth."""
    most: int = 5000
    """Largest number of births per frame: more than who walks in needs, since below that number all of it is haze."""
    crowded: Literal["coarser", "none", "small-clusters"] = "coarser"
    """Where there would be more than ``most``: births in larger voxels, none, or those in the smallest clusters."""
    most_missing_share: float = 0.25
    """If a larger share of the pictures is missing there are no births: the light changed, or a camera moved."""
    size: float = 0.7
    """Standard deviation at birth, in units of the distance between neighbouring swept rays."""
    opacity: float = 0.7
    blame_share: float = 0.5
    """A free Gaussian is an outlier in a view if more than this share of its pixels is wrong."""
    blame_views: int = 2
    """A free Gaussian is removed if it is an outlier in at least this many views and in half of those that show it."""
    thin: ThinBirthConfig = field(default_factory=ThinBirthConfig)

    @property
    def for_thin(self) -> "BirthConfig":
        """The rules of the second sweep."""
        return replace(self, **vars(self.thin))


@dataclass(frozen=True)
class ViewResidual:
    """Wrong and missing pixels of a view.

    Args:
        view: the picture, reduced.
        wrong: ``[h, w]`` bool, pixels whose residual exceeds the threshold.
        missing_share: ``[h, w]`` share of the 5 x 5 pixels around whose residual exceeds frame 0's by the threshold.
    """

    view: View
    wrong: Tensor
    missing_share: Tensor


def view_residual(
    drawn: Tensor | None,
    view: View,
    color: CameraColor,
    *,
    floor: ResidualFloor | None,
    config: BirthConfig,
    backend: Backend,
    tiles: TileSelection | None = None,
) -> ViewResidual:
    """Compare a rendering ``[H, W, 3]`` with the picture of ``view``.

    Args:
        drawn: the rendering; None for one that is the picture itself.
        view: in full size.
        color: the colour correction of the cameras.
        floor: residuals of frame 0; None for none.
        config: the rules.
        backend: the compute back-end.
        tiles: the tiles that were drawn; elsewhere it is the picture. None for all.
    """
    scale = min(1.0, config.picture_width / view.camera.width)
    small = view.reduced(scale)
    if drawn is None or (floor is not None and view.index not in floor.maps):
        # Of a camera that was absent from frame 0 nothing is known to be new.
        none = torch.zeros(small.image.shape[:2], device=small.image.device)
        nothing = torch.zeros_like(none, dtype=torch.bool)
        known = small if drawn is None else View(small.index, small.camera, small.image, nothing)
        return ViewResidual(known, nothing, none)
    off = backend.picture_residual(
        drawn,
        small.image,
        gains=color.gains[view.index],
        biases=color.biases[view.index],
        tiles=tiles,
        outside=None if tiles is None else view.image,
        mask=small.mask,
    )
    limit = off.new_full((), config.missing_threshold)
    if floor is not None:
        limit = limit + interpolate(floor.maps[view.index][None, None], size=off.shape, mode="bilinear")[0, 0]
    missing = box_mean((off > limit).float(), MASK_PIXELS)
    return ViewResidual(small, off > config.residual_threshold, missing if small.mask is None else missing * small.mask)


def blamed_mask(coverage: Tensor, wrong: Tensor, *, least_pixels: float, config: BirthConfig) -> Tensor:
    """Mask ``[F]`` of the free Gaussians to remove, as outliers in several views.

    Args:
        coverage: ``[V, F]`` pixels that each covers, by blending weight.
        wrong: ``[V, F]`` wrong pixels among them.
        least_pixels: views where a Gaussian covers fewer pixels do not count.
        config: the rule.
    """
    seen = coverage > least_pixels
    bad = (seen & (wrong > config.blame_share * coverage)).sum(0)
    return (bad >= config.blame_views) & (2 * bad >= seen.sum(0))


@dataclass(frozen=True)
class Births:
    """What a sweep bears.

    Args:
        free: the new free Gaussians.
        refused_count: how many more it would have borne, had they not been more than ``BirthConfig.most``; always 0
            where births are coarser then (``BirthConfig.crowded``).
        merged_count: how many more it would have borne, had they not been made coarser for that reason.
    """

    free: FreeGaussians
    refused_count: int = 0
    merged_count: int = 0


def sweep_births(
    missing: Sequence[ViewResidual],
    depths: Mapping[int, Tensor],
    color: CameraColor,
    *,
    first_birth: int,
    config: BirthConfig,
    backend: Backend,
) -> Births:
    """New free Gaussians at points whose colour is missing in several views.

    Args:
        missing: of every training view.
        depths: by view index, rendered depth ``[h, w]``, infinite where nothing is rendered.
        color: colour corrections of the cameras.
        first_birth: identity of the first.
        config: the rule.
        backend: the compute back-end.

    Raises:
        MissingExtraError: SciPy is not installed.
    """
    views = [_sweep_view(entry, depths[entry.view.index], color) for entry in missing]
    points, colors, spacings = [], [], []
    for index, (entry, view) in enumerate(zip(missing, views)):
        lacking = entry.missing_share > 0.5
        rows, columns = (lacking & _strided_mask(config.pixel_step, lacking)).nonzero().unbind(1)
        if not len(rows):
            continue
        reachable = view.depths[view.depths.isfinite()]
        beyond = float(reachable.max()) if len(reachable) else 1e3 * view.near
        farthest = (1.02 * view.depths[rows, columns].clamp(max=beyond)).clamp(min=1.001 * view.near)
        swept = backend.sweep(
            views,
            index,
            torch.stack([columns, rows], -1),
            farthest,
            planes=config.planes,
            least_supports=config.least_supports,
            most_contradictions=config.most_contradictions,
        )
        good = swept.costs < config.most_cost
        z, x, y = swept.depths[good], columns[good] + 0.5, rows[good] + 0.5
        K, viewmat = view.K, view.viewmat
        local = torch.stack([(x - K[0, 2]) / K[0, 0] * z, (y - K[1, 2]) / K[1, 1] * z, z], -1)
        points.append((local - viewmat[:3, 3]) @ viewmat[:3, :3])
        colors.append(view.colors[rows[good], columns[good]])
        spacings.append(config.pixel_step * z / K[0, 0])
    if not points or not sum(len(group) for group in points):
        return Births(FreeGaussians.empty(views[0].colors))
    return _merge_points(
        torch.cat(points), torch.cat(colors), torch.cat(spacings), first_birth=first_birth, config=config
    )


def _sweep_view(entry: ViewResidual, depths: Tensor, color: CameraColor) -> SweepView:
    camera, index = entry.view.camera, entry.view.index
    if entry.view.mask is not None:
        # Behind a depth of 0 nothing is visible, so a masked pixel neither supports nor contradicts a point.
        depths = torch.where(entry.view.mask, depths, 0.0)
    colors = (entry.view.colors - color.biases[index]) / color.gains[index].clamp(min=1e-3)
    viewport = camera.viewport(colors)
    return SweepView(colors, entry.missing_share, depths, viewport.viewmat, viewport.K, camera.near)


def _strided_mask(step: int, like: Tensor) -> Tensor:
    """Mask of every ``step``-th pixel across and down."""
    mask = torch.zeros_like(like)
    mask[::step, ::step] = True
    return mask


def _merge_points(points: Tensor, colors: Tensor, spacings: Tensor, *, first_birth: int, config: BirthConfig) -> Births:
    """One free Gaussian per voxel of the points, if at least ``least_hits`` points lie around it."""
    try:
        from scipy.spatial import KDTree
    except ImportError as error:
        raise MissingExtraError("scipy", "capture") from error
    values, voxel = torch.cat([points, colors, spacings[:, None]], dim=1), float(spacings.median())
    tree = KDTree(points.double().numpy(force=True))
    finest = None
    while True:
        means, hits = _cells(values, tree, voxel)
        enough = hits >= config.least_hits
        wanted = int(enough.sum())
        finest = wanted if finest is None else finest
        if wanted <= config.most or voxel > COARSEST * float(spacings.median()):
            break
        if config.crowded == "none":
            return Births(FreeGaussians.empty(points), wanted)
        if config.crowded == "small-clusters":
            enough[enough.clone()] = _in_small_clusters(means[enough, :3], CLUSTER_VOXELS * voxel, most=config.most)
            break
        voxel *= 2.0**0.5  # Too many: what is missing is large, and is born coarser.
    order = hits.argsort(descending=True, stable=True)
    chosen = order[enough[order]][: config.most].sort().values
    count = len(chosen)
    centers, looks, sizes = means[chosen].split([3, 3, 1], dim=1)
    sizes = sizes * (voxel / float(spacings.median()))
    unit = points.new_tensor([1.0, 0.0, 0.0, 0.0])
    opacity = torch.logit(torch.tensor(config.opacity)).to(points)
    return Births(
        FreeGaussians(
            means=centers.contiguous(),
            log_scales=(config.size * sizes).log().expand(count, 3).contiguous(),
            quats=unit.expand(count, 4).clone(),
            logit_opacities=opacity.expand(count).clone(),
            colors=looks.contiguous(),
            births=first_birth + torch.arange(count, device=points.device),
        ),
        refused_count=wanted - count if config.crowded == "small-clusters" else 0,
        merged_count=max(0, finest - count) if config.crowded == "coarser" else 0,
    )


def _in_small_clusters(means: Tensor, reach: float, *, most: int) -> Tensor:
    """Mask ``[C]`` of the points ``means`` ``[C, 3]`` in the smallest clusters, as many whole ones as have at most
    ``most`` points; points nearer than ``reach`` are in one cluster."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    pairs = KDTree(means.double().numpy(force=True)).query_pairs(reach, output_type="ndarray")
    near = coo_matrix((np.ones(len(pairs), bool), pairs.T), shape=(len(means), len(means)))
    _, cluster = connected_components(near, directed=False)
    sizes = np.bincount(cluster)
    order = sizes.argsort(kind="stable")
    chosen = order[sizes[order].cumsum() <= most]
    return torch.from_numpy(np.isin(cluster, chosen)).to(means.device)


def _cells(values: Tensor, tree: Any, voxel: float) -> tuple[Tensor, Tensor]:
    """Means ``[C, 7]`` of the rows of ``values`` in each cell of side ``voxel``, and how many points of ``tree`` lie
    around each, ``[C]``."""
    cells, of = (values[:, :3] / voxel).round().to(torch.int64).unique(dim=0, return_inverse=True)
    counts = values.new_zeros(len(cells)).index_add_(0, of, torch.ones_like(values[:, 0]))
    means = values.new_zeros(len(cells), values.shape[1]).index_add_(0, of, values) / counts[:, None]
    hits = tree.query_ball_point(means[:, :3].double().numpy(force=True), HIT_VOXELS * voxel, return_length=True)
    return means, torch.from_numpy(np.asarray(hits)).to(values.device)

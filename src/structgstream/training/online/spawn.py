# SPDX-License-Identifier: Apache-2.0
"""Free Gaussians where content is missing, before the first iteration (not in the paper).

Spawning by gradients places a faint child near a parent, which then needs frames to converge. Where pixels of several
views still have a large residual after the scene flow, new content is located directly by a plane sweep: along the ray
of such a pixel, in front of the rendered depth, at the depth where other views have the same missing colour. Free
Gaussians that are outliers in several views are pruned first.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from structgstream.cameras import Camera
from structgstream.errors import MissingExtraError
from structgstream.gaussians import concatenate
from structgstream.kernels.backend import Backend
from structgstream.kernels.values import SweepView, TileSelection
from structgstream.scene.active_tiles import ActiveTiles
from structgstream.scene.color import CameraColor
from structgstream.scene.free import FreeGaussians
from structgstream.scene.render import draw
from structgstream.scene.scene import Scene
from structgstream.training.online.config import SpawnConfig, SpawnRules
from structgstream.training.online.measure import VISIBLE_PIXELS, accumulate
from structgstream.training.online.split import DynamicSplit, changed_tiles
from structgstream.training.residuals import ResidualFloor, box_mean
from structgstream.training.views import View, mean_of_counting

MASK_PIXELS = 5
HIT_VOXELS = 1.8
COARSEST = 8.0
"""Spawned Gaussians are coarser than the swept rays by at most about this."""
CLUSTER_VOXELS = 2.0
"""Spawned Gaussians nearer to each other than this belong to one cluster."""


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
    rules: SpawnRules,
    backend: Backend,
    tiles: TileSelection | None = None,
) -> ViewResidual:
    """Compare a rendering ``[H, W, 3]`` with the picture of ``view``.

    Args:
        drawn: the rendering; None for one that is the picture itself.
        view: in full size.
        color: the colour correction of the cameras.
        floor: residuals of frame 0; None for none.
        rules: the rules.
        backend: the compute back-end.
        tiles: the tiles that were drawn; elsewhere it is the picture. None for all.
    """
    scale = min(1.0, rules.picture_width / view.camera.width)
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
    limit = off.new_full((), rules.missing_threshold)
    if floor is not None:
        limit = limit + interpolate(floor.maps[view.index][None, None], size=off.shape, mode="bilinear")[0, 0]
    missing = box_mean((off > limit).float(), MASK_PIXELS)
    return ViewResidual(small, off > rules.residual_threshold, missing if small.mask is None else missing * small.mask)


def outlier_mask(coverage: Tensor, wrong: Tensor, *, rules: SpawnRules) -> Tensor:
    """Mask ``[F]`` of the free Gaussians to remove, as outliers in several of the views in which they are visible.

    Args:
        coverage: ``[V, F]`` pixels that each covers, by blending weight.
        wrong: ``[V, F]`` wrong pixels among them.
        rules: the rule.
    """
    seen = coverage > VISIBLE_PIXELS
    bad = (seen & (wrong > rules.outlier_share * coverage)).sum(0)
    return (bad >= rules.outlier_views) & (2 * bad >= seen.sum(0))


@dataclass(frozen=True)
class Spawned:
    """Gaussians spawned by one sweep.

    Args:
        free: the new free Gaussians.
        refused_count: how many more there were, if these are more than ``SpawnRules.most``; always 0
            where Gaussians are coarser then (``SpawnRules.overflow``).
        merged_count: how many more there would be, had they not been made coarser for that reason.
    """

    free: FreeGaussians
    refused_count: int = 0
    merged_count: int = 0


def spawn_by_sweep(
    missing: Sequence[ViewResidual],
    depths: Mapping[int, Tensor],
    color: CameraColor,
    *,
    first_identity: int,
    rules: SpawnRules,
    backend: Backend,
) -> Spawned:
    """New free Gaussians at points whose colour is missing in several views.

    Args:
        missing: of every training view.
        depths: by view index, rendered depth ``[h, w]``, infinite where nothing is rendered.
        color: colour corrections of the cameras.
        first_identity: identity of the first.
        rules: the rule.
        backend: the compute back-end.

    Raises:
        MissingExtraError: SciPy is not installed.
    """
    views = [_sweep_view(entry, depths[entry.view.index], color) for entry in missing]
    points, colors, spacings = [], [], []
    for index, (entry, view) in enumerate(zip(missing, views)):
        lacking = entry.missing_share > 0.5
        rows, columns = (lacking & _strided_mask(rules.pixel_step, lacking)).nonzero().unbind(1)
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
            planes=rules.planes,
            min_supports=rules.min_supports,
            max_contradictions=rules.max_contradictions,
        )
        good = swept.costs < rules.max_cost
        z, x, y = swept.depths[good], columns[good] + 0.5, rows[good] + 0.5
        K, viewmat = view.K, view.viewmat
        local = torch.stack([(x - K[0, 2]) / K[0, 0] * z, (y - K[1, 2]) / K[1, 1] * z, z], -1)
        points.append((local - viewmat[:3, 3]) @ viewmat[:3, :3])
        colors.append(view.colors[rows[good], columns[good]])
        spacings.append(rules.pixel_step * z / K[0, 0])
    if not points or not sum(len(group) for group in points):
        return Spawned(FreeGaussians.empty(views[0].colors))
    return _merge_points(
        torch.cat(points), torch.cat(colors), torch.cat(spacings), first_identity=first_identity, rules=rules
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


def _merge_points(
    points: Tensor, colors: Tensor, spacings: Tensor, *, first_identity: int, rules: SpawnRules
) -> Spawned:
    """One free Gaussian per voxel of the points, if at least ``min_hits`` points lie around it."""
    try:
        from scipy.spatial import KDTree
    except ImportError as error:
        raise MissingExtraError("scipy", "capture") from error
    values, voxel = torch.cat([points, colors, spacings[:, None]], dim=1), float(spacings.median())
    tree = KDTree(points.double().numpy(force=True))
    finest = None
    while True:
        means, hits = _cells(values, tree, voxel)
        enough = hits >= rules.min_hits
        wanted = int(enough.sum())
        finest = wanted if finest is None else finest
        if wanted <= rules.most or voxel > COARSEST * float(spacings.median()):
            break
        if rules.overflow == "none":
            return Spawned(FreeGaussians.empty(points), wanted)
        if rules.overflow == "small-clusters":
            enough[enough.clone()] = _in_small_clusters(means[enough, :3], CLUSTER_VOXELS * voxel, most=rules.most)
            break
        voxel *= 2.0**0.5  # Too many: what is missing is large, and coarser Gaussians fill it.
    order = hits.argsort(descending=True, stable=True)
    chosen = order[enough[order]][: rules.most].sort().values
    count = len(chosen)
    centers, looks, sizes = means[chosen].split([3, 3, 1], dim=1)
    sizes = sizes * (voxel / float(spacings.median()))
    unit = points.new_tensor([1.0, 0.0, 0.0, 0.0])
    opacity = torch.logit(torch.tensor(rules.opacity)).to(points)
    return Spawned(
        FreeGaussians(
            means=centers.contiguous(),
            log_scales=(rules.size * sizes).log().expand(count, 3).contiguous(),
            quats=unit.expand(count, 4).clone(),
            logit_opacities=opacity.expand(count).clone(),
            colors=looks.contiguous(),
            births=first_identity + torch.arange(count, device=points.device),
        ),
        refused_count=wanted - count if rules.overflow == "small-clusters" else 0,
        merged_count=max(0, finest - count) if rules.overflow == "coarser" else 0,
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


MIN_COVERAGE = 0.5
"""Pixels with less coverage have no depth."""
DEPTH_WIDTH = 240
"""Depth maps are drawn at most this wide, pixels, and enlarged: they cost most of a frame without spawning."""


@dataclass(frozen=True)
class Missing:
    """Missing pixels of a view.

    Args:
        view: in full size.
        residual: of the rendering.
        tiles: those in which something is missing or wrong, or all; None for a view without active tiles.
        picture: ``[H, W, 3]`` the rendering; None for a view without active tiles.
        drawn: mask ``[rows, columns]`` of the tiles in which it was drawn anew; None for none.
    """

    view: View
    residual: ViewResidual
    tiles: TileSelection | None
    picture: Tensor | None = None
    drawn: Tensor | None = None

    @cached_property
    def any(self) -> bool:
        """Whether there are any."""
        return bool((self.residual.missing_share > 0.5).any())


def missing_share(missing: Sequence[Missing]) -> float:
    """Share of the pixels of all views that are missing."""
    shares = [mean_of_counting((m.residual.missing_share > 0.5).float(), m.residual.view.mask) for m in missing]
    return float(torch.stack(shares).mean())


@dataclass(frozen=True)
class Sweep:
    """One sweep.

    Args:
        dynamic: the dynamic part after the scene flow, with folded appearance.
        static: the rest, with folded appearance.
        views: of the frame.
        active_tiles: by view index, the tiles that the dynamic part reaches.
        floor: residuals of frame 0; None for none.
        rules: the rules.
        backend: the compute back-end.
        known: by view index, what a sweep of the same Gaussians by other rules has drawn.
    """

    dynamic: Scene
    static: Scene
    views: Sequence[View]
    active_tiles: Mapping[int, ActiveTiles]
    floor: ResidualFloor | None
    rules: SpawnRules
    backend: Backend
    known: Mapping[int, Missing] = field(default_factory=dict)

    def missing(self, *, prunes: bool = True) -> list[Missing]:
        """Missing pixels of every view, none outside its active tiles.

        Args:
            prunes: whether outliers will be pruned by wrong pixels, which then must be rendered again as well.
        """
        # The pictures are from before the second round: tiles without missing pixels then are assumed to have none.
        found = [self._before(view, wrong=prunes) for view in self.views]
        every = prunes and len(self.dynamic.free) > 0
        if not every and not self._enough(found):
            return found
        return [self._drawn(entry) if every or entry.any else entry for entry in found]

    def drawn(self, missing: Sequence[Missing]) -> list[Missing]:
        """The same views, drawn again."""
        return [self._drawn(entry, again=True) for entry in missing]

    def spawn(self, missing: Sequence[Missing], *, first_identity: int, room: int) -> Spawned:
        """New free Gaussians where several views miss the same; at most ``room``."""
        if not self._enough(missing):
            return Spawned(FreeGaussians.empty(self.dynamic.free.means))
        residuals = [entry.residual for entry in missing]
        return spawn_by_sweep(
            residuals,
            {entry.view.index: self.depth_map(entry.view) for entry in residuals},
            self.dynamic.camera_color,
            first_identity=first_identity,
            rules=replace(self.rules, most=min(self.rules.most, room)),
            backend=self.backend,
        )

    def _enough(self, missing: Sequence[Missing]) -> bool:
        """Whether enough views have missing pixels to spawn from."""
        return sum(entry.any for entry in missing) > self.rules.min_supports

    def _before(self, view: View, *, wrong: bool) -> Missing:
        """By the picture that is drawn already; ``wrong`` pixels make their tiles suspect, too."""
        active, known = self.active_tiles.get(view.index), self.known.get(view.index)
        if active is None:
            return Missing(view, self._residual(view, None), None)
        picture = active.picture if known is None or known.picture is None else known.picture
        residual = self._residual(view, picture)
        suspect = residual.missing_share > 0.5
        tiles = changed_tiles(active.tiles, suspect | residual.wrong if wrong else suspect)
        return Missing(view, residual, tiles, picture, None if known is None else known.drawn)

    def _drawn(self, entry: Missing, *, again: bool = False) -> Missing:
        """By a rendering, in the suspect tiles; in those drawn before only ``again``."""
        view, active = entry.view, self.active_tiles.get(entry.view.index)
        if active is None or entry.picture is None:
            return entry
        tiles = entry.tiles or active.tiles
        if entry.drawn is not None and not again:
            tiles = replace(tiles, mask=tiles.mask & ~entry.drawn)
            if not tiles.mask.any():
                return entry
        onto = replace(active, picture=entry.picture.clone(), tiles=tiles)
        gaussians = self.dynamic.with_free_gaussians(self.dynamic.structured(view.camera, self.backend, tiles=tiles))
        behind = self.dynamic.background(view.camera)
        image = draw(gaussians, view.camera, self.backend, active=onto, background=behind).image
        drawn = tiles.mask if entry.drawn is None else tiles.mask | entry.drawn
        return replace(entry, residual=self._residual(view, image), picture=image, drawn=drawn)

    def _residual(self, view: View, image: Tensor | None) -> ViewResidual:
        """Of a rendering ``[H, W, 3]`` within the active tiles; None for a view without one."""
        active = self.active_tiles.get(view.index)
        return view_residual(
            None if active is None else image,
            view,
            self.dynamic.camera_color,
            floor=self.floor,
            rules=self.rules,
            backend=self.backend,
            tiles=None if active is None else active.tiles,
        )

    def depth_map(self, view: View) -> Tensor:
        """Mean depth along z ``[h, w]`` of both parts drawn together; infinite where coverage is low.

        Of the static part only what reaches the active tiles is drawn, if there is one: beyond it nothing has changed,
        so a point that projects there is refused as if it were visible.
        """
        camera, active = _reduced(view.camera), self.active_tiles.get(view.index)
        at_rest = self.static.gaussians(camera, self.backend) if active is None else active.static
        gaussians = concatenate(self.dynamic.gaussians(camera, self.backend), at_rest)
        viewmat = camera.viewport(gaussians.means).viewmat
        z = gaussians.means @ viewmat[2, :3] + viewmat[2, 3]
        rendering = draw(replace(gaussians, colors=z[:, None].expand(-1, 3).contiguous()), camera, self.backend)
        depth = rendering.image[..., 0] / rendering.alpha.clamp(min=MIN_COVERAGE)
        depth = torch.where(rendering.alpha > MIN_COVERAGE, depth, torch.inf)
        return interpolate(depth[None, None], size=(view.camera.height, view.camera.width))[0, 0]


def _reduced(camera: Camera) -> Camera:
    return camera.scaled(min(1.0, DEPTH_WIDTH / camera.width))


@dataclass(frozen=True)
class SpawnResult:
    """Which free Gaussians of a dynamic part stay, and the new ones.

    Args:
        kept: mask ``[F]`` of those that stay.
        new_free: the spawned ones.
        thin_count: how many of them are thin content's.
        thin_refused_count: how many thin ones were not spawned because they would have been too many.
        merged_count: how many more there would be, had they not been made coarser because they were too many.
        refused: whether too much is missing to spawn anything.
    """

    kept: Tensor
    new_free: FreeGaussians
    thin_count: int = 0
    thin_refused_count: int = 0
    merged_count: int = 0
    refused: bool = False

    @property
    def counts(self) -> dict[str, int]:
        """How often each part acted, for the log."""
        return {
            "spawned": len(self.new_free),
            "spawned thin": self.thin_count,
            "refused thin": self.thin_refused_count,
            "merged": self.merged_count,
            "pruned outliers": int((~self.kept).sum()),
            "spawning refused": int(self.refused),
        }


def prune_and_spawn(
    split: DynamicSplit,
    views: Sequence[View],
    active_tiles: Mapping[int, ActiveTiles],
    *,
    first_identity: int,
    floor: ResidualFloor | None,
    room: int,
    config: SpawnConfig,
    backend: Backend,
) -> SpawnResult:
    """Prune outlier free Gaussians and spawn new ones before the first iteration.

    Args:
        split: with its dynamic part after the scene flow.
        views: of the frame.
        active_tiles: by view index, the tiles that the dynamic part reaches.
        first_identity: identity of the first new Gaussian.
        floor: residuals of frame 0; None for none.
        room: largest number of new Gaussians.
        config: the rules.
        backend: the compute back-end.
    """
    dynamic, static = (part.with_folded_appearance() for part in (split.dynamic, split.static))
    everything = torch.ones(len(dynamic.free), dtype=torch.bool, device=dynamic.free.means.device)
    none = SpawnResult(everything, FreeGaussians.empty(dynamic.free.means))
    if not config.enabled or not active_tiles:
        return none
    with torch.no_grad():
        rules, eased = config.rules, floor
        if floor is not None and config.CHANGED_FLOOR_MEDIANS is not None:
            eased = floor.eased(split.selection.changed, medians=config.CHANGED_FLOOR_MEDIANS)
        sweep = Sweep(dynamic, static, views, active_tiles, eased, rules, backend)
        missing = sweep.missing()
        if missing_share(missing) > rules.max_missing_share:
            return replace(none, refused=True)
        kept = everything
        if len(dynamic.free):
            kept = ~_outlier_mask(dynamic, missing, active_tiles, rules=rules, backend=backend)
        if not kept.all():
            sweep = replace(sweep, dynamic=replace(dynamic, free=dynamic.free.select(kept)))
            missing = sweep.drawn(missing)
        room = max(0, room - int(kept.sum()))
        large = sweep.spawn(missing, first_identity=first_identity, room=room)
        if len(large.free) or not config.thin.enabled:
            return SpawnResult(kept, large.free, merged_count=large.merged_count)
        known = {entry.view.index: entry for entry in missing}
        # With all of frame 0's floor: by these low thresholds an eased one would take all that moves for thin content.
        thin_sweep = replace(sweep, floor=floor, rules=config.thin_rules, known=known)
        thin = _spawn_thin(thin_sweep, first_identity=first_identity, room=room)
    return SpawnResult(kept, thin.free, len(thin.free), thin.refused_count)


def _spawn_thin(sweep: Sweep, *, first_identity: int, room: int) -> Spawned:
    """Spawn thin content, where nothing large is spawned."""
    missing = sweep.missing(prunes=False)
    if missing_share(missing) > sweep.rules.max_missing_share:
        return Spawned(FreeGaussians.empty(sweep.dynamic.free.means))
    return sweep.spawn(missing, first_identity=first_identity, room=room)


def _outlier_mask(
    dynamic: Scene,
    missing: Sequence[Missing],
    active_tiles: Mapping[int, ActiveTiles],
    *,
    rules: SpawnRules,
    backend: Backend,
) -> Tensor:
    coverage, wrong = [], []
    for entry in missing:
        view = entry.residual.view
        active, camera = active_tiles.get(view.index), view.camera
        if active is None:
            continue
        # Elsewhere free Gaussians cover nothing: maps that are zero there cost nothing.
        free = dynamic.free_gaussians()
        reached = backend.rasterize(free, camera.viewport(free.means)).alpha > 0.0
        counting = reached if view.mask is None else reached & view.mask
        maps = torch.stack([counting, counting & entry.residual.wrong], dim=-1).to(entry.residual.missing_share)
        gaussians = dynamic.with_free_gaussians(dynamic.structured(camera, backend, tiles=TileSelection.of(reached)))
        sums = accumulate(gaussians, camera, maps, backend, static=active.static)
        of_free = sums[len(sums) - len(dynamic.free) :]  # Free Gaussians are the last, and all there.
        coverage.append(of_free[:, 0])
        wrong.append(of_free[:, 1])
    return outlier_mask(torch.stack(coverage), torch.stack(wrong), rules=rules)

# SPDX-License-Identifier: Apache-2.0
"""Free Gaussians where content is missing, before the first iteration (not in the paper).

Spawning by gradients places a faint child near a parent, which then needs frames to converge. Where pixels of several
views still have a large residual after the scene flow, new content is located directly by a plane sweep: along the ray
of such a pixel, in front of the rendered depth, at the depth where other views have the same missing colour. Free
Gaussians that are outliers in several views are pruned first.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from structgstream.cameras import Camera, Viewport
from structgstream.gaussians import Gaussians
from structgstream.kernels.backend import Backend, on_processor
from structgstream.kernels.values import SweepView, TileSelection
from structgstream.scene.active_tiles import ActiveTiles
from structgstream.scene.color import CameraColor
from structgstream.scene.free import FreeGaussians
from structgstream.scene.scene import Scene
from structgstream.training.neighbours import kd_tree
from structgstream.training.online.config import SpawnConfig, SpawnRules
from structgstream.training.online.measure import VISIBLE_PIXELS, slot_count
from structgstream.training.online.split import DynamicSplit, changed_tiles
from structgstream.training.online.view_residuals import ViewResidual, view_residuals
from structgstream.training.residuals import BaselineResidual
from structgstream.training.views import View, by_size, in_groups, stacked_masks

HIT_VOXELS = 1.8
COARSEST = 8.0
"""Spawned Gaussians are coarser than the swept rays by at most about this."""
CLUSTER_VOXELS = 2.0
"""Spawned Gaussians nearer to each other than this belong to one cluster."""


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
        refused_count: number of candidates that were not spawned because there were more than ``SpawnRules.most``;
            always 0 with ``SpawnRules.overflow`` ``coarser``.
        merged_count: how many fewer there are because they were made coarser for that reason.
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
        missing: of each view.
        depths: by view index, rendered depth ``[h, w]``, infinite where nothing is rendered.
        color: colour corrections of the cameras.
        first_identity: identity of the first.
        rules: the rule.
        backend: the compute back-end.

    Raises:
        MissingExtraError: SciPy is not installed.
    """
    views = [_sweep_view(entry, depths[entry.view.index], color) for entry in missing]
    values, costs = [], []
    for index, view in enumerate(views):
        if missing[index].missing_pixels == 0.0:
            continue
        step = rules.pixel_step
        rows, columns = (step * (view.missing[::step, ::step] > 0.5).nonzero()).unbind(1)
        reachable = torch.where(view.depths.isfinite(), view.depths, -torch.inf).max()
        beyond = torch.where(reachable.isfinite(), reachable, 1e3 * view.near)
        farthest = (1.02 * torch.minimum(view.depths[rows, columns], beyond)).clamp(min=1.001 * view.near)
        swept = backend.sweep(
            views,
            index,
            torch.stack([columns, rows], -1),
            farthest,
            planes=rules.planes_of(view.near),
            min_supports=rules.min_supports,
            max_contradictions=rules.max_contradictions,
        )
        z, x, y = swept.depths, columns + 0.5, rows + 0.5
        K, viewmat = view.K, view.viewmat
        local = torch.stack([(x - K[0, 2]) / K[0, 0] * z, (y - K[1, 2]) / K[1, 1] * z, z], -1)
        points, spacings = (local - viewmat[:3, 3]) @ viewmat[:3, :3], step * z / K[0, 0]
        values.append(torch.cat([points, view.colors[rows, columns], spacings[:, None]], dim=1))
        costs.append(swept.costs)
    like = views[0].colors
    none = Spawned(FreeGaussians.empty(like))
    if not values:
        return none
    found, cost = on_processor(torch.cat(values), torch.cat(costs))  # Where points are merged.
    found = found[cost < rules.max_cost]
    if not len(found):
        return none
    spawned = _merge_points(found, first_identity=first_identity, rules=rules)
    return replace(spawned, free=spawned.free.to(like.device))


def _sweep_view(entry: ViewResidual, depths: Tensor, color: CameraColor) -> SweepView:
    camera, index = entry.view.camera, entry.view.index
    if entry.view.mask is not None:
        # Behind a depth of 0 nothing is visible, so a masked pixel neither supports nor contradicts a point.
        depths = torch.where(entry.view.mask, depths, 0.0)
    colors = (entry.view.colors - color.biases[index]) / color.gains[index].clamp(min=1e-3)
    viewport = camera.viewport(colors)
    return SweepView(colors, entry.missing_share, depths, viewport.viewmat, viewport.K, camera.near)


def _merge_points(values: Tensor, *, first_identity: int, rules: SpawnRules) -> Spawned:
    """One free Gaussian per voxel of the points, if at least ``min_hits`` points lie around it; on the processor.

    A row of ``values`` ``[P, 7]`` is a point, its colour, and the distance between neighbouring swept rays there.
    """
    points, spacing = values[:, :3], float(values[:, 6].median())
    tree, voxel, finest = kd_tree(points), spacing, None
    while True:
        means, hits = _cells(values, tree, voxel)
        enough = hits >= rules.min_hits
        wanted = int(enough.sum())
        finest = wanted if finest is None else finest
        if wanted <= rules.most or voxel > COARSEST * spacing:
            break
        if rules.overflow == "none":
            return Spawned(FreeGaussians.empty(points), wanted)
        if rules.overflow == "small-clusters":
            enough[enough.clone()] = _in_small_clusters(means[enough, :3], CLUSTER_VOXELS * voxel, most=rules.most)
            break
        voxel *= 2.0**0.5  # Too many: what is missing is large, and coarser Gaussians fill it.
    order = hits.argsort(descending=True, stable=True)
    chosen = order[enough[order]][: rules.most].sort().values
    centers, looks, sizes = means[chosen].split([3, 3, 1], dim=1)
    sizes = sizes * (voxel / spacing)
    return Spawned(
        FreeGaussians.spawned(
            centers.contiguous(),
            (rules.size * sizes).log().repeat(1, 3),
            looks.contiguous(),
            opacity=rules.opacity,
            first_identity=first_identity,
        ),
        refused_count=wanted - len(chosen) if rules.overflow == "small-clusters" else 0,
        merged_count=max(0, finest - len(chosen)) if rules.overflow == "coarser" else 0,
    )


def _in_small_clusters(means: Tensor, reach: float, *, most: int) -> Tensor:
    """Mask ``[C]`` of the points ``means`` ``[C, 3]`` in the smallest clusters, as many whole ones as have at most
    ``most`` points; points nearer than ``reach`` are in one cluster."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    pairs = kd_tree(means).query_pairs(reach, output_type="ndarray")
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
DEPTH_PIXELS = 240
"""Depth maps are drawn with at most this longer side, and enlarged: they cost most of a frame without spawning."""


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

    @property
    def any(self) -> bool:
        """Whether there are any."""
        return self.residual.missing_pixels > 0.0


def missing_share(missing: Sequence[Missing]) -> float:
    """Share of the pixels of all views that are missing."""
    return float(torch.tensor([m.residual.missing_pixels for m in missing]).mean())


@dataclass(frozen=True)
class Sweep:
    """One sweep.

    Args:
        dynamic: the dynamic part after the scene flow, with folded appearance.
        static: the rest, with folded appearance.
        views: inliers, those with flow if there are any.
        active_tiles: by view index, the tiles that the dynamic part reaches.
        baseline: residuals of frame 0; None for none.
        rules: the rules.
        backend: the compute back-end.
    """

    dynamic: Scene
    static: Scene
    views: Sequence[View]
    active_tiles: Mapping[int, ActiveTiles]
    baseline: BaselineResidual | None
    rules: SpawnRules
    backend: Backend

    def missing(self, *, prunes: bool = True, known: Sequence[Missing] = ()) -> list[Missing]:
        """Missing pixels of every view, none outside its active tiles.

        Args:
            prunes: whether outliers will be pruned by wrong pixels, which then must be rendered again as well.
            known: what a sweep of the same Gaussians and views by other rules has drawn.
        """
        # The pictures are from before the second round: tiles without missing pixels then are assumed to have none.
        found = self._before(wrong=prunes, known=known)
        every = prunes and len(self.dynamic.free) > 0
        if not every and not self._enough(found):
            return found
        return self._drawn(found, chosen=[every or entry.any for entry in found])

    def drawn(self, missing: Sequence[Missing]) -> list[Missing]:
        """The same views, drawn again."""
        return self._drawn(missing, chosen=[True] * len(missing), again=True)

    def spawn(self, missing: Sequence[Missing], *, first_identity: int, room: int) -> Spawned:
        """New free Gaussians where several views miss the same; at most ``room``."""
        if not self._enough(missing):
            return Spawned(FreeGaussians.empty(self.dynamic.free.means))
        residuals = [entry.residual for entry in missing]
        return spawn_by_sweep(
            residuals,
            dict(zip((e.view.index for e in residuals), self.depth_maps([e.view for e in residuals]), strict=True)),
            self.dynamic.camera_color,
            first_identity=first_identity,
            rules=replace(self.rules, most=min(self.rules.most, room)),
            backend=self.backend,
        )

    def _enough(self, missing: Sequence[Missing]) -> bool:
        """Whether enough views have missing pixels to spawn from."""
        return sum(entry.any for entry in missing) > self.rules.min_supports

    def _before(self, *, wrong: bool, known: Sequence[Missing]) -> list[Missing]:
        """By the pictures that are drawn already; ``wrong`` pixels make their tiles suspect, too."""
        views = list(self.views)
        actives = [self.active_tiles.get(view.index) for view in views]
        pictures = [None if active is None else active.picture for active in actives]
        drawn: list[Tensor | None] = [None] * len(views)
        if known:
            pictures, drawn = [entry.picture for entry in known], [entry.drawn for entry in known]
        residuals = self._residuals(views, pictures)

        def suspect_tiles(rows: list[int]) -> Sequence[TileSelection | None]:
            if pictures[rows[0]] is None:
                return [None] * len(rows)
            pixels = torch.stack([residuals[row].missing_share for row in rows]) > 0.5
            if wrong:
                pixels = pixels | torch.stack([residuals[row].wrong for row in rows])
            tiles = [self.active_tiles[views[row].index].tiles for row in rows]
            size = (tiles[0].height, tiles[0].width)
            masks = changed_tiles(torch.stack([of_view.mask for of_view in tiles]), list(pixels), size)
            return [replace(of_view, mask=mask) for of_view, mask in zip(tiles, masks, strict=True)]

        tiles = in_groups(
            range(len(views)),
            lambda row: (views[row].image.shape, pictures[row] is None),
            suspect_tiles,
            device=self.backend.device,
        )
        return list(map(Missing, views, residuals, tiles, pictures, drawn))

    def _drawn(self, entries: Sequence[Missing], *, chosen: Sequence[bool], again: bool = False) -> list[Missing]:
        """By renderings of the ``chosen`` ones in the suspect tiles; in those drawn before only ``again``."""
        drawn = [entry for entry, wanted in zip(entries, chosen, strict=True) if wanted and entry.picture is not None]
        found = in_groups(
            drawn,
            lambda entry: (entry.view.image.shape, entry.view.camera.near),
            lambda alike: self._draw(alike, again=again),
            device=self.backend.device,
        )
        by_view = {entry.view.index: entry for entry in found}
        return [by_view.get(entry.view.index, entry) for entry in entries]

    def _draw(self, entries: Sequence[Missing], *, again: bool) -> list[Missing]:
        """:meth:`_drawn` of views of one size that all have active tiles."""
        tiles = [entry.tiles or self.active_tiles[entry.view.index].tiles for entry in entries]
        masks = torch.stack([of_view.mask for of_view in tiles])
        none = torch.zeros_like(masks[0])
        before = torch.stack([none if entry.drawn is None else entry.drawn for entry in entries])
        masks = masks if again else masks & ~before
        rows = [row for row, some in enumerate(masks.flatten(1).any(1).tolist()) if some]
        views, found = [entries[row].view for row in rows], list(entries)
        if not rows:
            return found
        tiles = [replace(tiles[row], mask=masks[row]) for row in rows]
        cameras = [view.camera for view in views]
        drawn = self.backend.draw_views(
            self.dynamic.gaussians_of_views(cameras, self.backend, tiles=tiles),
            [camera.viewport(self.dynamic.anchors.positions) for camera in cameras],
            static=[self.active_tiles[view.index].static for view in views],
            backgrounds=self.dynamic.backgrounds(cameras),
            tiles=tiles,
            onto=list(torch.stack([picture for row in rows if (picture := entries[row].picture) is not None])),
        )
        images, together = [output.image for output in drawn], masks | before
        for row, residual, image in zip(rows, self._residuals(views, images), images, strict=True):
            found[row] = replace(entries[row], residual=residual, picture=image, drawn=together[row])
        return found

    def _residuals(self, views: Sequence[View], images: Sequence[Tensor | None]) -> list[ViewResidual]:
        """Of renderings ``[H, W, 3]`` within the active tiles; None for a view without one."""
        actives = [self.active_tiles.get(view.index) for view in views]
        return view_residuals(
            images,
            views,
            self.dynamic.camera_color,
            baseline=self.baseline,
            rules=self.rules,
            backend=self.backend,
            tiles=[None if active is None else active.tiles for active in actives],
        )

    def depth_maps(self, views: Sequence[View]) -> list[Tensor]:
        """Mean depth along z ``[h, w]`` of both parts drawn together; infinite where coverage is low.

        Of the static part only what reaches the active tiles is drawn, if there is one: beyond it nothing has changed,
        so a point that projects there is refused as if it were visible.
        """
        return by_size(views, self._depth_maps)

    def _depth_maps(self, views: Sequence[View]) -> Tensor:
        cameras = [_reduced(view.camera) for view in views]
        whole = [camera for view, camera in zip(views, cameras, strict=True) if view.index not in self.active_tiles]
        of_whole = iter(self.static.gaussians_of_views(whole, self.backend) if whole else [])
        actives = [self.active_tiles.get(view.index) for view in views]
        static = [next(of_whole) if active is None else active.static for active in actives]
        dynamic = self.dynamic.gaussians_of_views(cameras, self.backend)
        viewports = [camera.viewport(self.dynamic.anchors.positions) for camera in cameras]
        drawn = self.backend.draw_views(
            list(map(_colored_by_depth, dynamic, viewports)),
            viewports,
            static=list(map(_colored_by_depth, static, viewports)),
        )
        alphas = torch.stack([output.alpha for output in drawn])
        depths = torch.stack([output.image[..., 0] for output in drawn]) / alphas.clamp(min=MIN_COVERAGE)
        depths = torch.where(alphas > MIN_COVERAGE, depths, torch.inf)
        size = (views[0].camera.height, views[0].camera.width)
        return interpolate(depths[:, None], size=size)[:, 0]


def _colored_by_depth(gaussians: Gaussians, viewport: Viewport) -> Gaussians:
    """The Gaussians with their depth along z as colour."""
    z = gaussians.means @ viewport.viewmat[2, :3] + viewport.viewmat[2, 3]
    return replace(gaussians, colors=z[:, None].expand(-1, 3).contiguous())


def _reduced(camera: Camera) -> Camera:
    return camera.scaled(min(1.0, DEPTH_PIXELS / max(camera.width, camera.height)))


@dataclass(frozen=True)
class SpawnResult:
    """Which free Gaussians of a dynamic part stay, and the new ones.

    Args:
        kept: mask ``[F]`` of those that stay, on the processor.
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
    baseline: BaselineResidual | None,
    room: int,
    config: SpawnConfig,
    backend: Backend,
) -> SpawnResult:
    """Prune outlier free Gaussians and spawn new ones before the first iteration.

    Args:
        split: with its dynamic part after the scene flow.
        views: inliers, those with flow if there are any.
        active_tiles: by view index, the tiles that the dynamic part reaches.
        first_identity: identity of the first new Gaussian.
        baseline: residuals of frame 0; None for none.
        room: largest number of free Gaussians of the dynamic part, kept and new ones together.
        config: the rules.
        backend: the compute back-end.
    """
    dynamic, static = (part.with_folded_appearance() for part in (split.dynamic, split.static))
    everything = torch.ones(len(dynamic.free), dtype=torch.bool)
    none = SpawnResult(everything, FreeGaussians.empty(dynamic.free.means))
    if not config.enabled or not active_tiles:
        return none
    with torch.no_grad():
        rules, medians = config.rules, config.BASELINE_CAP_MEDIANS
        capped = None if baseline is None else baseline.capped(split.selection.changed, medians=medians)
        sweep = Sweep(dynamic, static, views, active_tiles, capped, rules, backend)
        missing = sweep.missing()
        if missing_share(missing) > rules.max_missing_share:
            return replace(none, refused=True)
        kept = everything
        if len(dynamic.free):
            kept = ~_outlier_mask(dynamic, missing, active_tiles, rules=rules, backend=backend)
            (kept,) = on_processor(kept)
        if not kept.all():
            sweep = replace(sweep, dynamic=replace(dynamic, free=dynamic.free.select(kept)))
            missing = sweep.drawn(missing)
        room = max(0, room - int(kept.sum()))
        large = sweep.spawn(missing, first_identity=first_identity, room=room)
        if len(large.free) or not config.thin.enabled:
            return SpawnResult(kept, large.free, merged_count=large.merged_count)
        # With the whole baseline: at these low thresholds a capped one would take all that moves for thin content.
        sweep = replace(sweep, baseline=baseline, rules=config.thin_rules)
        missing = sweep.missing(prunes=False, known=missing)
        if missing_share(missing) > sweep.rules.max_missing_share:
            return replace(none, kept=kept)
        thin = sweep.spawn(missing, first_identity=first_identity, room=room)
    return SpawnResult(kept, thin.free, len(thin.free), thin.refused_count)


def _outlier_mask(
    dynamic: Scene,
    missing: Sequence[Missing],
    active_tiles: Mapping[int, ActiveTiles],
    *,
    rules: SpawnRules,
    backend: Backend,
) -> Tensor:
    seen = [entry.residual for entry in missing if entry.residual.view.index in active_tiles]
    wrong = {entry.view.index: entry.wrong for entry in seen}
    free, slots = dynamic.free_gaussians(), slot_count(dynamic)

    def weighed(views: list[View]) -> Tensor:
        cameras, masks = [view.camera for view in views], stacked_masks(views)
        viewports = [camera.viewport(free.means) for camera in cameras]
        # Elsewhere free Gaussians cover nothing: maps that are zero there cost nothing.
        drawn = backend.draw_views([free] * len(views), viewports)
        reached = torch.stack([output.alpha for output in drawn]) > 0.0
        counting = reached if masks is None else reached & masks
        maps = torch.stack([counting, counting & torch.stack([wrong[view.index] for view in views])], dim=-1)
        return backend.weigh_views(
            dynamic.gaussians_of_views(cameras, backend, tiles=TileSelection.of_each(reached)),
            viewports,
            maps.to(free.means),
            slots=slots,
            static=[active_tiles[view.index].static for view in views],
        )

    sums = torch.stack(by_size([entry.view for entry in seen], weighed))[:, slots - len(free) :]
    return outlier_mask(sums[..., 0], sums[..., 1], rules=rules)

# SPDX-License-Identifier: Apache-2.0
"""Fit of a group's first frame from the scene of frame 0 and tracked positions, without the frames between.

Optimization alone cannot bridge large motion, so anchors start at their tracked positions (``tracking``). Rounds of
flow from the rendering to the pictures, spawning and iterations follow. The rate term counts changes against frame 0,
from which a key packet is predicted. Primitives that neither moved nor have a high error retain frame 0's exact values,
so all groups have the same background.

Note [Lost anchors]
~~~~~~~~~~~~~~~~~~~
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
from structgstream.training.online.config import OnlineConfig, SpawnRules
from structgstream.training.online.exposure import ExposureReference, with_exposure_of
from structgstream.training.online.measure import measure, primitive_sums, slot_count
from structgstream.training.online.optimize import FrameOptimizer, StartingPoint
from structgstream.training.online.patching import next_identity
from structgstream.training.online.preprocess import PictureChange, flow_views
from structgstream.training.online.scene_flow import residual_flow
from structgstream.training.online.select import select_dynamic
from structgstream.training.online.spawn import outlier_mask, prune_and_spawn
from structgstream.training.online.split import DynamicSplit, find_active_tiles, with_displacements
from structgstream.training.online.view_residuals import view_residuals
from structgstream.training.parameters import pixel_size
from structgstream.training.residuals import BaselineResidual
from structgstream.training.result import FitResult, StepListener, Stopwatch
from structgstream.training.views import View

NEIGHBOURS = 32
"""Number of nearest inlier anchors of frame 0 whose displacements a lost anchor gets."""
FEATURE_BANDWIDTH = 0.5
"""A neighbour's weight is a Gaussian of the root mean square difference of features; this is its standard deviation, in
standard deviations of the features."""
MIN_LOST_PIXELS = 3.0
"""Anchors that would move by no more pixels than this are not relocated."""
MEDIAN_STEPS = 12


def relocate_lost_anchors(
    dynamic: Scene,
    first: AnchorCloud,
    views: Sequence[View],
    active_tiles: Mapping[int, ActiveTiles],
    *,
    baseline: BaselineResidual | None,
    rules: SpawnRules,
    backend: Backend,
) -> tuple[Scene, int]:
    """``dynamic`` with its lost anchors displaced as their neighbours, and the number of moved anchors; ``first`` are
    its anchors in frame 0, in the same order. Views without up-to-date renderings in ``active_tiles`` are skipped.
    Raises MissingExtraError without SciPy."""
    pixel = pixel_size(first.positions, [view.camera for view in views])
    if pixel is None or len(first) < 2:
        return dynamic, 0
    with torch.no_grad():
        outliers = _outlier_anchors(dynamic, views, active_tiles, baseline, rules, backend)
        if not outliers.any() or outliers.all():
            return dynamic, 0
        positions = dynamic.anchors.positions
        displacements = positions - first.positions
        rows = outliers.nonzero()[:, 0]
        expected = _displacements_of_neighbours(first, displacements, rows, ~outliers)
        far = (expected - displacements[rows]).norm(dim=1) > MIN_LOST_PIXELS * pixel
        rows, expected = rows[far], expected[far]
        positions = positions.index_copy(0, rows, first.positions[rows] + expected)
    return replace(dynamic, anchors=replace(dynamic.anchors, positions=positions)), len(rows)


def _outlier_anchors(
    dynamic: Scene,
    views: Sequence[View],
    active_tiles: Mapping[int, ActiveTiles],
    baseline: BaselineResidual | None,
    rules: SpawnRules,
    backend: Backend,
) -> Tensor:
    """Mask ``[M]`` of the anchors that are outliers in several views (``spawn.outlier_mask``)."""
    folded, coverage, wrong = dynamic.with_folded_appearance(), [], []
    for view in views:
        active = active_tiles.get(view.index)
        if active is None:
            continue
        (found,) = view_residuals(
            [active.picture], [view], dynamic.camera_color, baseline=baseline, rules=rules, backend=backend
        )
        small = found.view
        pixels = found.wrong.to(active.picture)
        counting = torch.ones_like(pixels) if small.mask is None else small.mask.to(pixels)
        weighed = backend.weigh_views(
            [folded.gaussians(small.camera, backend)],
            [small.camera.viewport(pixels)],
            torch.stack([counting, pixels], dim=-1)[None],
            slots=slot_count(folded),
            static=[active.static],
        )
        sums = primitive_sums(weighed[0], folded)[: len(dynamic.anchors)]
        coverage.append(sums[:, 0])
        wrong.append(sums[:, 1])
    if not coverage:
        return torch.zeros(len(dynamic.anchors), dtype=torch.bool, device=dynamic.anchors.positions.device)
    return outlier_mask(torch.stack(coverage), torch.stack(wrong), rules=rules)


def _displacements_of_neighbours(first: AnchorCloud, displacements: Tensor, rows: Tensor, inliers: Tensor) -> Tensor:
    """Weighted geometric median ``[R, 3]`` of the displacements of the neighbours of ``rows`` in frame 0.

    Neighbours are chosen from the mask ``inliers``. Unlike a mean, the median ignores a few neighbours on another body.
    """
    among = inliers.nonzero()[:, 0]
    near, _ = nearest(first.positions[rows], first.positions[among], NEIGHBOURS)
    near = among[near]
    features = first.features.detach()
    features = features / features.std(0).clamp(min=1e-6)
    differences = (features[near] - features[rows][:, None]).square().mean(-1)
    weights = torch.exp(-0.5 * differences / FEATURE_BANDWIDTH**2).clamp(min=1e-12)
    values = displacements[near]
    median = (weights[..., None] * values).sum(1) / weights.sum(1, keepdim=True)
    for _ in range(MEDIAN_STEPS):  # Weiszfeld
        shares = weights / (values - median[:, None]).norm(dim=-1).clamp(min=1e-6)
        median = (shares[..., None] * values).sum(1) / shares.sum(1, keepdim=True)
    return median


USUAL_FRAMES = 11
"""Iterations of a group's first frame, in those of an online frame. With fewer, spawned Gaussians replace what
iterations would have corrected, which costs bytes, and late groups lose quality (lab/notes/groups-measured.md)."""


SMOOTHNESS_SHARE = 0.25
"""Weight of the motion smoothness ``online.smoothness``, measured from frame 0 here, relative to that of other frames.
The full weight suits moving bodies, but costs 0.8 dB where the appearance changes in place, because displacements also
have to represent that change."""


@dataclass(frozen=True)
class GroupStartConfig:
    """The fit of a group's first frame; not in the paper."""

    iterations: int | None = None
    """Optimisation steps of all rounds together; None for :data:`USUAL_FRAMES` times those of an online frame."""
    rounds: int = 3
    """Rounds of flow, spawning and iterations."""
    births: int = 2000
    """Largest number of Gaussians spawned in a round, for content that appeared since frame 0."""


def fit_group_start(
    scene: Scene,
    displacements: Tensor,
    views: list[View],
    changes: list[PictureChange | None],
    *,
    frame_index: int,
    config: OnlineConfig,
    start: GroupStartConfig,
    backend: Backend,
    seed: int,
    steps: Mapping[str, float] | None = None,
    baseline: BaselineResidual | None = None,
    light: ExposureReference | None = None,
    on_step: StepListener | None = None,
) -> FitResult[Scene]:
    """Fit ``scene``, the decoded scene of frame 0, to a later frame.

    Args:
        displacements: ``[M + F, 3]`` of its primitives (Note [Primitives]) since frame 0, as tracked.
        changes: change of each picture since frame 0; a view with None does not vote.
        light: exposure reference of frame 0, for ``config.exposure``; None for none.
    """
    iterations = USUAL_FRAMES * config.iterations if start.iterations is None else start.iterations
    each = replace(
        config,
        iterations=-(-iterations // start.rounds),
        spawn=replace(config.spawn, most=start.births),
        smoothness=replace(config.smoothness, weight=SMOOTHNESS_SHARE * config.smoothness.weight),
    )
    if config.exposure.enabled and light is not None:
        step = None if steps is None else steps.get("color_mlp")
        scene = with_exposure_of(scene, views, light, config=config.exposure, step=step)

    optimizer = FrameOptimizer(
        each, backend, frame_index, torch.Generator().manual_seed(seed), Stopwatch(), steps or {}, on_step
    )
    rounds = _Rounds(optimizer, scene, views, changes, baseline)
    current, results = with_displacements(scene, displacements), list[FitResult[Scene]]()
    for number in range(start.rounds):
        results.append(rounds.run(current, again=number > 0))
        current = results[-1].scene
    return _together(results)


@dataclass(frozen=True)
class _Rounds:
    """State that the rounds of a group's first frame share; ``first`` is frame 0."""

    fit: FrameOptimizer
    first: Scene
    views: list[View]
    changes: list[PictureChange | None]
    baseline: BaselineResidual | None

    def run(self, current: Scene, *, again: bool) -> FitResult[Scene]:
        """One round from ``current``, whose anchors are those of frame 0; ``again`` if it is not the first."""
        fit, config, backend = self.fit, self.fit.config, self.fit.backend
        with fit.watch.stage("select"):
            split = self._partition(current)
            inliers = [self.views[number] for number in split.selection.inliers]
        with fit.watch.stage("relocate lost anchors"):
            # In the first round, flow and iterations may still find these anchors.
            split, relocated = self._relocated(split, inliers) if again else (split, 0)
        with fit.watch.stage("scene flow"):
            displaced, lifted = self._displaced(split, inliers)
            active_tiles = find_active_tiles(displaced, inliers, config=config.motion, backend=backend)
        with fit.watch.stage("spawn"):
            new = prune_and_spawn(
                displaced,
                inliers,
                active_tiles,
                first_identity=next_identity(current.free.births, fit.frame_index),
                baseline=self.baseline,
                room=config.patching.max_free - len(split.static.free),
                config=config.spawn,
                backend=backend,
            )
        dynamic = replace(displaced.dynamic, free=displaced.dynamic.free.select(new.kept))
        begun = StartingPoint(
            dynamic,
            inliers,
            torch.zeros(len(dynamic.anchors) + len(dynamic.free), 3).to(dynamic.anchors.positions),
            displaced,
            active_tiles,
            new.new_free,
            reference=replace(dynamic, anchors=self.first.anchors.select(split.selection.anchors)),
        )
        result = fit.run(begun)
        return replace(
            result,
            scene=displaced.merge(result.scene),
            pruned=result.pruned + int((~new.kept).sum()),
            spawned=result.spawned + len(new.new_free),
            counts={**result.counts, "corrected": lifted, "relocated": relocated, **new.counts},
        )

    def _partition(self, current: Scene) -> DynamicSplit:
        """Dynamic: primitives that changed, have a high error or are displaced from frame 0. Static: all others."""
        fit, config = self.fit, self.fit.config
        measured = measure(
            current, self.views, self.changes, config=config.motion, backend=fit.backend, baseline=self.baseline
        )
        found = select_dynamic(current, measured, config=config.motion, backend=fit.backend)
        away = (current.anchors.positions != self.first.anchors.positions).any(1)
        return DynamicSplit.of(current, replace(found, anchors=found.anchors | away, free=torch.ones_like(found.free)))

    def _relocated(self, split: DynamicSplit, views: list[View]) -> tuple[DynamicSplit, int]:
        """``split`` with its lost anchors displaced as their neighbours, and the number of moved anchors."""
        fit, config = self.fit, self.fit.config
        dynamic, count = relocate_lost_anchors(
            split.dynamic,
            self.first.anchors.select(split.selection.anchors),
            views,
            find_active_tiles(split, views, config=config.motion, backend=fit.backend),
            baseline=self.baseline,
            rules=config.spawn.rules,
            backend=fit.backend,
        )
        return replace(split, dynamic=dynamic), count

    def _displaced(self, split: DynamicSplit, views: list[View]) -> tuple[DynamicSplit, int]:
        """``split`` after flow from its rendering to the pictures, and the number of displaced primitives."""
        fit, config = self.fit, self.fit.config
        chosen = flow_views(views, fit.frame_index, config.scene_flow)
        seen = [view for view in views if view.index in chosen]
        if not seen:
            return split, 0
        found = residual_flow(
            split.dynamic,
            seen,
            find_active_tiles(split, seen, config=config.motion, backend=fit.backend),
            scale=config.motion.picture_scale,
            backend=fit.backend,
        )
        return split.displaced(found.displacements), int(found.lifted.sum())


def _together(results: list[FitResult[Scene]]) -> FitResult[Scene]:
    """The last round's result, with counts and seconds summed over all rounds."""
    last = results[-1]
    return replace(
        last,
        iterations=sum(result.iterations for result in results),
        spawned=sum(result.spawned for result in results),
        pruned=sum(result.pruned for result in results),
        counts={name: sum(result.counts[name] for result in results) for name in last.counts},
    )

# SPDX-License-Identifier: Apache-2.0
"""The first frame of a group: from the scene of frame 0 and tracked positions, without the frames between.

A jump to a far frame fails where things moved far, so anchors begin where ``tracking`` followed them to. Rounds of flow
from the rendering to the pictures, births, and iterations do the rest. Changes are priced against frame 0, which a key
packet is predicted from (``price``), and what neither moved nor looks wrong keeps frame 0's bits, so that the
background of all groups is the same.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from structgstream.kernels.backend import Backend
from structgstream.scene.free import FreeGaussians
from structgstream.scene.scene import Scene
from structgstream.training.light import LightReference, with_light_of
from structgstream.training.motion import segment_motion
from structgstream.training.motion_start import flow_views, residual_motion, with_displacements
from structgstream.training.next_frame import StartingPoint
from structgstream.training.observation import slot_count
from structgstream.training.online import FrameFit, run_frame_fit
from structgstream.training.online_config import OnlineConfig
from structgstream.training.partition import Partition, focus_views
from structgstream.training.patching import BIRTHS_PER_FRAME
from structgstream.training.picture_change import PictureChange
from structgstream.training.renewal import renew_free_gaussians
from structgstream.training.residuals import ResidualFloor
from structgstream.training.result import FitResult, StepListener
from structgstream.training.stragglers import StragglerConfig, recall_stragglers
from structgstream.training.views import View

USUAL_FRAMES = 11
"""A group's first frame has the iterations of so many online frames. With fewer, births stand in for what iterations
would have mended, which costs bytes, and late groups fall behind (lab/notes/groups-measured.md)."""


@dataclass(frozen=True)
class GroupStartConfig:
    """The fit of a group's first frame; not in the paper."""

    iterations: int | None = None
    """Optimisation steps of all rounds together; None for :data:`USUAL_FRAMES` times those of an online frame."""
    rounds: int = 3
    """Rounds of flow, births and iterations."""
    flow_rounds: int = 1
    """Displacements by flow from the rendering to the pictures before the iterations of a round. Each adds noise."""
    stragglers: StragglerConfig = StragglerConfig()
    """Anchors that tracking lost."""
    births: int = 2000
    """Largest number of births in a round: content that came since frame 0."""
    coherence_share: float = 0.25
    """Weight of ``online.coherence``, which counts from frame 0 here, relative to that of other frames. All of it suits
    bodies that move, but costs 0.8 dB where looks change in place, as displacements also stand in for them."""


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
    floor: ResidualFloor | None = None,
    light: LightReference | None = None,
    on_step: StepListener | None = None,
) -> FitResult[Scene]:
    """Fit ``scene``, the decoded scene of frame 0, to a later frame.

    Args:
        scene: of frame 0.
        displacements: ``[M + F, 3]`` of its movers (Note [Movers]) since frame 0, as tracked.
        views: the pictures.
        changes: of each of them since frame 0; a view without one does not vote.
        frame_index: of the frame, for the identities of births.
        config: of online frames.
        start: of this fit.
        backend: the compute back-end.
        seed: of all random numbers.
        steps: quantization steps (Note [Bins]).
        floor: residuals of frame 0; None for none.
        light: of frame 0, for ``config.light``; None for none.
        on_step: called after every iteration.
    """
    iterations = USUAL_FRAMES * config.iterations if start.iterations is None else start.iterations
    each = replace(
        config,
        iterations=-(-iterations // start.rounds),
        births=replace(config.births, most=start.births),
        coherence=replace(config.coherence, weight=start.coherence_share * config.coherence.weight),
    )
    if config.light.enabled and light is not None:
        step = None if steps is None else steps.get("color_mlp")
        scene = with_light_of(scene, views, light, config=config.light, step=step)

    def fit_with(fit: FrameFit) -> FitResult[Scene]:
        rounds = _Rounds(fit, start, scene, views, changes, floor)
        current, results = with_displacements(scene, displacements), []
        for number in range(start.rounds):
            results.append(rounds.run(current, again=number > 0))
            current = results[-1].scene
        return _together(results)

    return run_frame_fit(
        fit_with,
        config=each,
        backend=backend,
        frame_index=frame_index,
        seed=seed,
        steps=steps,
        on_step=on_step,
        slots=slot_count(scene) + start.births * start.rounds,
    )


@dataclass(frozen=True)
class _Rounds:
    """What the rounds of a group's first frame share; ``first`` is frame 0."""

    fit: FrameFit
    start: GroupStartConfig
    first: Scene
    views: list[View]
    changes: list[PictureChange | None]
    floor: ResidualFloor | None

    def run(self, current: Scene, *, again: bool) -> FitResult[Scene]:
        """One round from ``current``, whose anchors are those of frame 0; ``again`` if it is not the first."""
        fit, config, backend = self.fit, self.fit.config, self.fit.backend
        with fit.watch.stage("find motion"):
            partition = self._partition(current)
            trusted = [self.views[number] for number in partition.segmentation.trusted]
        with fit.watch.stage("recall stragglers"):
            # What the first round's flow and iterations have found needs no help.
            partition, recalled = self._recalled(partition, trusted) if again else (partition, 0)
        with fit.watch.stage("start motion"):
            displaced, lifted = self._displaced(partition, trusted)
            focuses = focus_views(displaced, trusted, config=config.motion, backend=backend)
        with fit.watch.stage("renew"):
            new = renew_free_gaussians(
                displaced,
                trusted,
                focuses,
                first_birth=self._first_birth(current.free),
                floor=self.floor,
                room=config.patching.max_free - len(partition.still.free),
                least_pixels=config.motion.least_pixels,
                config=config.births,
                backend=backend,
            )
        moving = replace(displaced.moving, free=displaced.moving.free.select(new.kept))
        begun = StartingPoint(
            moving,
            trusted,
            torch.zeros(len(moving.anchors) + len(moving.free), 3).to(moving.anchors.positions),
            displaced,
            focuses,
            new.new_free,
            reference=replace(moving, anchors=self.first.anchors.select(partition.segmentation.anchors)),
        )
        result = fit.optimize(begun)
        return replace(
            result,
            scene=displaced.merge(result.scene),
            pruned=result.pruned + int((~new.kept).sum()),
            spawned=result.spawned + len(new.new_free),
            counts={**result.counts, "corrected": lifted, "recalled": recalled, **new.counts},
        )

    def _partition(self, current: Scene) -> Partition:
        """What has changed, looks wrong, or is not where frame 0 has it, against the rest."""
        fit, config = self.fit, self.fit.config
        found = segment_motion(
            current, self.views, self.changes, config=config.motion, backend=fit.backend, floor=self.floor
        )
        away = (current.anchors.positions != self.first.anchors.positions).any(1)
        return Partition.of(current, replace(found, anchors=found.anchors | away, free=torch.ones_like(found.free)))

    def _recalled(self, partition: Partition, views: list[View]) -> tuple[Partition, int]:
        """``partition`` with its stragglers where their neighbours are; how many they are."""
        fit, config = self.fit, self.fit.config
        moving, count = recall_stragglers(
            partition.moving,
            self.first.anchors.select(partition.segmentation.anchors),
            views,
            focus_views(partition, views, config=config.motion, backend=fit.backend),
            floor=self.floor,
            least_pixels=config.motion.least_pixels,
            births=config.births,
            config=self.start.stragglers,
            backend=fit.backend,
        )
        return replace(partition, moving=moving), count

    def _displaced(self, partition: Partition, views: list[View]) -> tuple[Partition, int]:
        """``partition`` after rounds of flow from its rendering to the pictures; how many movers flow displaced."""
        fit, config = self.fit, self.fit.config
        chosen = flow_views(views, fit.frame_index, config.start)
        seen, lifted = [view for view in views if view.index in chosen], 0
        for _ in range(self.start.flow_rounds if chosen else 0):
            found = residual_motion(
                partition.moving,
                seen,
                focus_views(partition, seen, config=config.motion, backend=fit.backend),
                scale=config.motion.picture_scale,
                config=config.start,
                backend=fit.backend,
            )
            lifted = int(found.lifted.sum())
            partition = replace(partition, moving=with_displacements(partition.moving, found.displacements))
        return partition, lifted

    def _first_birth(self, free: FreeGaussians) -> int:
        """The first identity of the frame that no birth of an earlier round has."""
        first = self.fit.frame_index * BIRTHS_PER_FRAME
        return max(first, int(free.births.max()) + 1) if len(free) else first


def _together(results: list[FitResult[Scene]]) -> FitResult[Scene]:
    """The last round's result with the sums of all."""
    last = results[-1]
    return replace(
        last,
        iterations=sum(result.iterations for result in results),
        spawned=sum(result.spawned for result in results),
        pruned=sum(result.pruned for result in results),
        counts={name: sum(result.counts[name] for result in results) for name in last.counts},
    )

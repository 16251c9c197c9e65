# SPDX-License-Identifier: Apache-2.0
"""Every frame after the first: anchors move, free Gaussians patch (paper, section Methods).

::

    scene(t-1), decoded --> [ 50 steps ] --> prune free, spawn free --> [ 50 steps ] --> scene(t)
                              |                   ^
                              '-- view-space gradients by id
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from structgstream.cameras import CameraRig
from structgstream.frames import LEAST_CAMERAS, MultiViewFrame
from structgstream.kernels.backend import Backend, nonblocking
from structgstream.kernels.cuda_tiles import run_with_pair_budget
from structgstream.scene.sampling import RigSampling
from structgstream.scene.scene import Scene
from structgstream.scene.state import ParameterName
from structgstream.training.coherence import MotionCoherence
from structgstream.training.early_stopping import EarlyStopping
from structgstream.training.last_pass import LastPass
from structgstream.training.light import LightReference, with_light_of
from structgstream.training.mean_of_steps import MeanOfSteps
from structgstream.training.motion import SHARED_FIELDS, segment_motion
from structgstream.training.motion_start import estimate_initial_motion, with_displacements
from structgstream.training.next_frame import NextFrameHooks, StartingPoint
from structgstream.training.observation import slot_count
from structgstream.training.online_config import OnlineConfig, online_rates
from structgstream.training.optim import Adam
from structgstream.training.optimize import Schedule, optimize
from structgstream.training.parameters import FREE_ROWS, Parameters, detached, parameters_of_fields, values_of_rows
from structgstream.training.partition import Partition
from structgstream.training.patching import BIRTHS_PER_FRAME
from structgstream.training.picture_change import PictureChange
from structgstream.training.pictures import FramePictures, pictures_of
from structgstream.training.population import Population
from structgstream.training.price import BitPrice
from structgstream.training.renewal import renew_free_gaussians
from structgstream.training.residuals import ResidualFloor
from structgstream.training.result import FitResult, StepListener
from structgstream.training.statistics import GradientStatistics
from structgstream.training.stopwatch import Stopwatch
from structgstream.training.views import View, shuffled_views


def fit_next_frame(
    scene: Scene,
    frame: MultiViewFrame,
    rig: CameraRig,
    *,
    config: OnlineConfig,
    backend: Backend,
    seed: int,
    pictures: FramePictures | None = None,
    steps: Mapping[str, float] | None = None,
    older: Scene | None = None,
    intervals: float = 1.0,
    floor: ResidualFloor | None = None,
    light: LightReference | None = None,
    on_step: StepListener | None = None,
) -> FitResult[Scene]:
    """Fit ``scene``, the decoded scene of the previous frame, to ``frame``.

    Args:
        scene: the initial scene (Note [Closed loop]).
        frame: the pictures; only those of ``rig.training`` are read, of which some may be absent.
        rig: cameras in normalised units.
        config: of online frames.
        backend: the compute back-end.
        seed: of all random numbers, so that a frame can be repeated alone.
        steps: quantization steps (Note [Bins]); the parameters it names are drawn and returned quantized.
        older: the decoded scene two frames before, if :func:`needs_older`; None for none.
        intervals: media time since the previous frame, in times of that between the two before: what moved goes on.
        floor: residuals of frame 0, for ``config.motion.residual_threshold`` and for births; None for none.
        light: frame 0's, for ``config.light``; None for none.
        pictures: of ``frame``, and their changes since the previous one for motion segmentation (``config.motion``;
            :func:`~structgstream.training.pictures.pictures_of`); without them everything is trained.
        on_step: called after every iteration.
    """
    if pictures is None:
        pictures = pictures_of(frame, rig, before=None, motion=config.motion, start=config.start, backend=backend)
    if len(pictures.views) < min(LEAST_CAMERAS, len(rig.training)):
        return held(scene)
    if config.patching.lifetime == "frame":
        scene = scene.without_free()
    scene = replace(scene, sampling=RigSampling.of(rig) if config.sampling_filter else None)
    counts: dict[str, int] = {}
    if config.light.enabled and light is not None:
        step = None if steps is None else steps.get("color_mlp")
        lit = with_light_of(scene, pictures.views, light, config=config.light, step=step)
        counts["light changed"] = int(lit is not scene)
        scene = lit

    def fit_with(fit: FrameFit) -> FitResult[Scene]:
        displacements = _prior_displacements(scene, older, intervals * config.motion_prior)
        if pictures.changes is None:
            return fit.optimize(StartingPoint(scene, pictures.views, displacements))
        return _fit_moving_part(fit, scene, pictures.views, pictures.changes, displacements, older=older, floor=floor)

    result = run_frame_fit(
        fit_with,
        config=config,
        backend=backend,
        frame_index=frame.index,
        seed=seed,
        steps=steps,
        on_step=on_step,
        slots=slot_count(scene),
    )
    return replace(result, counts={**result.counts, **counts})


def held(scene: Scene) -> FitResult[Scene]:
    """The result of a frame whose pictures show nothing: the scene as it was."""
    return FitResult(detached(scene), iterations=0, train_psnr=math.nan, counts={"held": 1})


def needs_older(config: OnlineConfig) -> bool:
    """Whether a frame depends on the two decoded frames before it, instead of one."""
    return config.motion_prior != 0.0 or (config.motion.enabled and config.motion.moved_ease != 1.0)


def run_frame_fit(
    fit_with: "Callable[[FrameFit], FitResult[Scene]]",
    *,
    config: OnlineConfig,
    backend: Backend,
    frame_index: int,
    seed: int,
    steps: Mapping[str, float] | None,
    on_step: StepListener | None,
    slots: int,
) -> FitResult[Scene]:
    """Calls ``fit_with`` with a :class:`FrameFit`, on a GPU again with more memory if that of ``slots`` is short."""

    def run(iteration_backend: Backend) -> FitResult[Scene]:
        generator, watch = torch.Generator().manual_seed(seed), Stopwatch()
        return fit_with(
            FrameFit(config, backend, iteration_backend, frame_index, generator, watch, steps or {}, on_step)
        )

    if backend.name != "cuda":
        return run(backend)
    # The host can run ahead of a GPU because no iteration synchronises.
    return run_with_pair_budget(
        lambda budget: run(nonblocking(backend, budget)), capacity=max(1 << 18, 8 * slots), device=backend.device
    )


@dataclass(frozen=True)
class FrameFit:
    """The optimisation of one frame; ``iteration_backend`` is the back-end of the iterations."""

    config: OnlineConfig
    backend: Backend
    iteration_backend: Backend
    frame_index: int
    generator: torch.Generator
    watch: Stopwatch
    steps: Mapping[str, float]
    on_step: StepListener | None

    def optimize(self, start: StartingPoint) -> FitResult[Scene]:
        """Fit the scene of ``start`` to the pictures."""
        config, seen = self.config, start.seen
        if (sampling := start.scene.sampling) is not None:
            held = sampling.intervals(start.scene.anchors.positions + start.displacements[: len(start.scene.anchors)])
            start = replace(start, scene=replace(start.scene, anchor_intervals=held))
        # Each view is used as often as in a full frame.
        iterations = math.ceil(config.iterations * len(seen) / len(start.views))
        samples = shuffled_views(seen, self.generator)
        hooks = self._hooks(start, iterations)
        schedule = Schedule(iterations, lambda iteration: online_rates(config, (iteration - 1) / iterations))
        population, last_pass = hooks.population, hooks.last_pass
        recorder = None if self.iteration_backend.recorder is None else self.iteration_backend.recorder()
        done = optimize(
            population.adam,
            samples,
            schedule,
            hooks,
            watch=self.watch,
            on_step=self.on_step,
            recorder=recorder,
        )
        if hooks.average is not None:
            hooks.average.apply(hooks.parameters.values)
        return FitResult(
            scene=detached(hooks.parameters.scene(start.scene)),
            iterations=done,
            train_psnr=last_pass.psnr,
            moving=len(start.scene.anchors),
            spawned=population.spawned,
            pruned=population.pruned,
            counts={} if recorder is None else {"recorded": len(recorder), "replayed": recorder.replays},
            seconds=self.watch.seconds,
            losses=last_pass.terms,
        )

    def _hooks(self, start: StartingPoint, iterations: int) -> NextFrameHooks:
        config, patching, scene, seen = self.config, self.config.patching, start.scene, start.seen
        parameters, bit_price = self._parameters(start)
        adam = Adam(self.backend, parameters.values)
        _displace_parameters(parameters, adam, start)
        still_free = 0 if start.partition is None else len(start.partition.still.free)
        population = Population(
            config=patching,
            template=scene,
            parameters=parameters,
            adam=adam,
            statistics=GradientStatistics(
                slot_count(scene) + (0 if start.new_free is None else len(start.new_free)), self.backend.device
            ),
            views=seen,
            frame_index=self.frame_index,
            room=patching.max_free - still_free,
            backend=self.backend,
            generator=self.generator,
        )
        rests = rest_every(config.motion.rest_every, views=len(seen), iterations=iterations)
        return NextFrameHooks(
            start=start,
            parameters=parameters,
            losses=config.losses,
            bit_price=bit_price,
            coherence=MotionCoherence.of(start.known, [view.camera for view in start.views], config=config.coherence),
            population=population,
            early_stopping=EarlyStopping(config.least_gain * len(start.views) / max(1, config.iterations), len(seen)),
            patch_at=math.ceil(patching.iteration * len(seen) / len(start.views)),
            patches="free" in config.dynamic,
            last_pass=LastPass(
                0 if config.least_gain else iterations - len(seen),
                terms_after=0 if config.least_gain else iterations - rests * len(seen),
            ),
            backend=self.iteration_backend,
            watch=self.watch,
            rest_every=rests,
            iterations=iterations,
            average=MeanOfSteps(math.floor(iterations * (1.0 - config.mean_of_last))) if config.mean_of_last else None,
        )

    def _parameters(self, start: StartingPoint) -> tuple[Parameters, BitPrice | None]:
        """The leaves of the scene as it was, and the price of changing their bins since then or ``start.reference``."""
        config = self.config
        dynamic = config.trained if start.partition is None else config.trained.difference(SHARED_FIELDS)
        trained = parameters_of_fields(dynamic)
        steps: dict[ParameterName, float] = {name: self.steps[name] for name in trained if name in self.steps}
        parameters = Parameters.of(start.scene, trained=trained, steps=steps)
        rounding = config.rounding.resolved()
        known, free = parameters, rounding.free_priced
        if start.reference is not None:
            known, free = Parameters.of(start.reference, trained=trained, steps=steps), False
        return parameters, BitPrice.of(known, steps, weight=rounding.rate_weight, free=free)


def rest_every(most: int, *, views: int, iterations: int) -> int:
    """At most ``most`` (``MotionConfig.rest_every``), and so few that each of the views draws all of its tiles once."""
    return max(1, min(most, iterations // max(views, 1)))


def _displace_parameters(parameters: Parameters, adam: Adam[ParameterName], start: StartingPoint) -> None:
    """Set the leaves to the frame's initial state, with the births."""
    values, anchors = parameters.values, len(start.scene.anchors)
    if values["anchor_positions"].requires_grad:
        values["anchor_positions"].data += start.displacements[:anchors]
    if not values["free_means"].requires_grad:
        return
    values["free_means"].data += start.displacements[anchors:]
    if start.new_free is not None:
        keep = torch.ones(len(start.scene.free), dtype=torch.bool, device=start.new_free.means.device)
        parameters.births = torch.cat([parameters.births, start.new_free.births])
        adam.replace_rows(values_of_rows(start.new_free, FREE_ROWS), keep=keep)


def _prior_displacements(scene: Scene, older: Scene | None, motion_prior: float) -> Tensor:
    """Initial displacements ``[M + F, 3]`` of the movers: a share of the anchors' last displacement."""
    displacements = torch.zeros(len(scene.anchors) + len(scene.free), 3).to(scene.anchors.positions)
    if older is not None and motion_prior:
        displacements[: len(scene.anchors)] = motion_prior * (scene.anchors.positions - older.anchors.positions)
    return displacements


def _fit_moving_part(
    fit: FrameFit,
    scene: Scene,
    views: list[View],
    changes: list[PictureChange | None],
    displacements: Tensor,
    *,
    older: Scene | None,
    floor: ResidualFloor | None,
) -> FitResult[Scene]:
    """Fit the moving part of ``scene``, after the motion start, and keep the still part."""
    config, backend, watch = fit.config, fit.backend, fit.watch
    with watch.stage("find motion"):
        segmentation = segment_motion(
            scene, views, changes, config=config.motion, backend=backend, older=older, floor=floor
        )
        partition, displacements = Partition.of(scene, segmentation), displacements[segmentation.movers]
        trusted = [views[number] for number in segmentation.trusted]
    with watch.stage("start motion"):
        start = estimate_initial_motion(
            partition, trusted, displacements, config=config.start, motion=config.motion, backend=backend
        )
    with watch.stage("renew"):
        chosen = segmentation.views_with_flow
        new = renew_free_gaussians(
            replace(partition, moving=with_displacements(partition.moving, start.displacements)),
            [view for view in trusted if view.index in chosen] if chosen else trusted,
            start.focuses,
            first_birth=fit.frame_index * BIRTHS_PER_FRAME,
            floor=floor,
            room=config.patching.max_free - len(partition.still.free),
            least_pixels=config.motion.least_pixels,
            config=config.births,
            backend=backend,
        )
        alive = torch.cat([torch.ones(len(partition.moving.anchors), dtype=torch.bool).to(new.kept), new.kept])
        moving = replace(partition.moving, free=partition.moving.free.select(new.kept))
    result = fit.optimize(
        StartingPoint(moving, trusted, start.displacements[alive], partition, start.focuses, new.new_free)
    )
    return replace(
        result,
        scene=partition.merge(result.scene),
        pruned=result.pruned + new.counts["blamed"],
        spawned=result.spawned + len(new.new_free),
        counts={
            **result.counts,
            "carried": segmentation.carried_count,
            "lifted": start.lifted_count,
            "corrected": start.corrected_count,
            "fast": start.fast_count,
            "fast lifted": start.fast_lifted_count,
            "far boxes": sum(change.far_boxes for change in changes if change is not None),
            **new.counts,
            "views left out": len(views) - len(trusted),
            "jumps": int(segmentation.scene_cut),
        },
    )

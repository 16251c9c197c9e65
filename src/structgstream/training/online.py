# SPDX-License-Identifier: Apache-2.0
"""Every frame after the first: anchors move, free Gaussians patch (paper, section Methods).

::

    scene(t-1), decoded --> [ 50 steps ] --> prune free, spawn free --> [ 50 steps ] --> scene(t)
                              |                   ^
                              '-- view-space gradients by id
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from structgstream.cameras import CameraRig
from structgstream.frames import MultiViewFrame
from structgstream.kernels.backend import Backend, nonblocking
from structgstream.kernels.cuda_tiles import with_enough_room
from structgstream.scene.focus import Focus
from structgstream.scene.free import FreeGaussians
from structgstream.scene.scene import Scene
from structgstream.scene.state import PAPER_DYNAMIC, STATE_TABLE, FieldName, ParameterName
from structgstream.training.births import BirthConfig
from structgstream.training.losses import LossWeights
from structgstream.training.motion import SHARED_FIELDS, MotionConfig, moving_parts
from structgstream.training.motion_start import MotionStartConfig, displaced, started
from structgstream.training.observation import slots_of
from structgstream.training.optim import Adam
from structgstream.training.parameters import (
    FREE_ROWS,
    Parameters,
    detached,
    parameters_of_fields,
    values_of_rows,
)
from structgstream.training.partition import Partition
from structgstream.training.patching import PatchingConfig
from structgstream.training.pictures import FramePictures, pictures_of
from structgstream.training.population import patched
from structgstream.training.price import Rate
from structgstream.training.renewal import renewal
from structgstream.training.residuals import ResidualFloor
from structgstream.training.result import FitResult, Step, StepListener
from structgstream.training.rounding import RoundingConfig
from structgstream.training.settling import Settling
from structgstream.training.statistics import GradientStatistics
from structgstream.training.step import LastPass, gradients_of, view_loss
from structgstream.training.stopwatch import Stopwatch
from structgstream.training.views import View, shuffled_views


@dataclass(frozen=True)
class OnlineRates:
    """Learning rates of online frames (paper, section Implementations), in units of the normalised scene."""

    anchor_positions: float = 4e-4
    offset_scales: float = 5e-3
    covariance_mlp: float = 4e-3
    free_means: float = 2e-4
    free_log_scales: float = 5e-3
    free_quats: float = 1e-3
    free_logit_opacities: float = 5e-2
    free_colors: float = 2.5e-3
    base_scales: float = 5e-3
    """Used only when ``base_scales`` is in the dynamic set, as are the following."""
    anchor_offsets: float = 1e-3
    anchor_features: float = 2.5e-3
    appearance: float = 2e-2
    opacity_mlp: float = 2e-3
    color_mlp: float = 4e-3
    final_share: float = 1.0
    """Rates of the anchors and MLPs fall log-linearly to this share within a frame (paper: constant)."""


@dataclass(frozen=True)
class OnlineConfig:
    """How a frame after the first is fitted."""

    iterations: int = 100
    dynamic: frozenset[FieldName] = PAPER_DYNAMIC
    """Rows of the state table that change after frame 0; the paper's ablations edit it."""
    appearance_rank: int = 4
    """Directions in which the features of an anchor may change, if ``appearance`` is dynamic."""
    losses: LossWeights = field(default_factory=LossWeights)
    rates: OnlineRates = field(default_factory=OnlineRates)
    patching: PatchingConfig = field(default_factory=PatchingConfig)
    motion: MotionConfig = field(default_factory=MotionConfig)
    start: MotionStartConfig = field(default_factory=MotionStartConfig)
    """Where what moves begins a frame; only with ``motion``."""
    births: BirthConfig = field(default_factory=BirthConfig)
    """What is born from geometry, and dies of blame, before the first iteration; only with ``motion``."""
    motion_prior: float = 0.0
    """Anchors that move begin a frame this share of their last step further on (the paper: 0, where they are)."""
    least_gain: float = 0.0
    """A frame ends, and patching comes, early when ``iterations`` at the present pace would lower its loss by less than
    this share (the paper: 0, never)."""
    rounding: RoundingConfig = field(default_factory=RoundingConfig)


def online_rates(config: OnlineConfig, share: float) -> dict[ParameterName, float]:
    """Learning rate of every parameter after ``share`` (0 to 1) of a frame's iterations."""
    falling = config.rates.final_share**share
    rates: dict[ParameterName, float] = {}
    for row in STATE_TABLE:
        for parameter in row.parameters:
            rate = getattr(config.rates, parameter.online_rate) if parameter.online_rate else 0.0
            rates[parameter.name] = rate if row.granularity == "free" else rate * falling
    return rates


def fit_next_frame(
    scene: Scene,
    frame: MultiViewFrame,
    rig: CameraRig,
    *,
    config: OnlineConfig,
    backend: Backend,
    seed: int,
    before: MultiViewFrame | None = None,
    pictures: FramePictures | None = None,
    steps: Mapping[str, float] | None = None,
    older: Scene | None = None,
    floor: ResidualFloor | None = None,
    on_step: StepListener | None = None,
) -> FitResult:
    """Bring ``scene``, the decoded scene of the frame before, to ``frame``.

    Args:
        scene: where to start (Note [Closed loop]).
        frame: the pictures; only those of ``rig.training`` are read.
        rig: cameras in normalised units.
        config: what may change, and how.
        backend: what computes.
        seed: all randomness comes from it, so a frame can be repeated alone.
        steps: of what is sent rounded (Note [Bins]); what it names is drawn rounded and comes back so.
        older: the decoded scene two frames before, for what has a memory (:func:`remembers`); None for none.
        floor: what frame 0 missed, for ``config.motion.residual_threshold`` and for births; None for nothing.
        before: the frame before, which tells what moves (``config.motion``); without it everything may.
        pictures: of ``frame`` after ``before`` (:func:`~structgstream.training.pictures.pictures_of`), where they were
            looked at already.
        on_step: called after every iteration.
    """
    if config.patching.lifetime == "frame":
        scene = scene.without_free()
    motion = config.motion
    if pictures is None:
        pictures = pictures_of(frame, rig, before=before, motion=motion, start=config.start, backend=backend)
    views, changes = pictures.views, pictures.changes

    def fitted(stepping: Backend) -> FitResult:
        generator, watch = torch.Generator().manual_seed(seed), Stopwatch(backend.device)
        fit = _Fit(config, backend, stepping, frame.index, generator, watch, steps or {}, on_step)
        ahead = torch.zeros(len(scene.anchors) + len(scene.free), 3).to(scene.anchors.positions)
        if older is not None and config.motion_prior:
            ahead[: len(scene.anchors)] = config.motion_prior * (scene.anchors.positions - older.anchors.positions)
        if changes is None:
            return fit.run(scene, views, ahead=ahead)
        with watch.stage("find motion"):
            which = moving_parts(scene, views, changes, config=motion, backend=backend, older=older, floor=floor)
            partition, ahead = Partition.of(scene, which), ahead[which.movers]
            trusted = [views[number] for number in which.trusted]
        with watch.stage("start motion"):
            start = started(partition, trusted, ahead, config=config.start, motion=motion, backend=backend)
        with watch.stage("renew"):
            new = renewal(
                replace(partition, moving=displaced(partition.moving, start.displacements)),
                trusted,
                start.places,
                frame_index=frame.index,
                floor=floor,
                room=config.patching.max_free - len(partition.still.free),
                least_pixels=motion.least_pixels,
                config=config.births,
                backend=backend,
            )
            alive = torch.cat([torch.ones(len(partition.moving.anchors), dtype=torch.bool).to(new.kept), new.kept])
            moving = replace(partition.moving, free=partition.moving.free.select(new.kept))
        ahead = start.displacements[alive]
        result = fit.run(moving, trusted, partition=partition, places=start.places, ahead=ahead, born=new.born)
        died = int((~new.kept).sum())
        return replace(
            result,
            scene=partition.together(result.scene),
            pruned=result.pruned + int(which.unseen.sum()) + died,
            spawned=result.spawned + len(new.born),
            counts={
                "lifted": start.lifted,
                "corrected": start.corrected,
                "born": len(new.born),
                "blamed": died,
                "births refused": int(new.refused),
                "views left out": len(views) - len(trusted),
                "jumps": int(which.jumped),
            },
        )

    if backend.device.type != "cuda":
        return fitted(backend)
    # The host runs ahead of a GPU as long as no iteration waits for it.
    return with_enough_room(
        lambda budget: fitted(nonblocking(backend, budget)),
        capacity=max(1 << 18, 8 * slots_of(scene)),
        device=backend.device,
    )


def remembers(config: OnlineConfig) -> bool:
    """Whether a frame is fitted after the two before it, instead of one."""
    return config.motion_prior != 0.0 or (config.motion.enabled and config.motion.moved_ease != 1.0)


@dataclass
class _Fit:
    """The optimisation of one frame; ``stepping`` is what the iterations run on."""

    config: OnlineConfig
    backend: Backend
    stepping: Backend
    frame_index: int
    generator: torch.Generator
    watch: Stopwatch
    steps: Mapping[str, float]
    on_step: StepListener | None

    def run(
        self,
        scene: Scene,
        views: list[View],
        *,
        ahead: Tensor,
        partition: Partition | None = None,
        places: Mapping[int, Focus] | None = None,
        born: FreeGaussians | None = None,
    ) -> FitResult:
        """Fit ``scene`` to the pictures, its movers (Note [Movers]) starting ``ahead`` ``[M + F, 3]`` of their places.

        With a partition it is its moving part, which shows in ``places`` by view index. What is ``born`` joins it.
        """
        config, watch, patching = self.config, self.watch, self.config.patching
        still_free = 0 if partition is None else len(partition.still.free)
        seen = views if places is None else [view for view in views if view.index in places]
        iterations = math.ceil(config.iterations * len(seen) / len(views))  # Each view as often as in a full frame.
        patch_at = math.ceil(patching.iteration * len(seen) / len(views))
        order = shuffled_views(seen, self.generator)
        dynamic = config.dynamic if partition is None else config.dynamic.difference(SHARED_FIELDS)
        trained = parameters_of_fields(dynamic)
        steps: dict[ParameterName, float] = {name: self.steps[name] for name in trained if name in self.steps}
        parameters = Parameters.of(scene, trained=trained, steps=steps)
        rounding = config.rounding.resolved()
        rate = Rate.of(parameters, steps, weight=rounding.rate_weight, free=rounding.free_priced)
        anchors = len(scene.anchors)  # What a step costs is counted from the last frame.
        if "anchor_positions" in trained:
            parameters.values["anchor_positions"].data += ahead[:anchors]
        if "free_means" in trained:
            parameters.values["free_means"].data += ahead[anchors:]
        if born is not None and "free_means" in trained:
            keep = torch.ones(len(scene.free), dtype=torch.bool, device=born.means.device)
            parameters.births = torch.cat([parameters.births, born.births])
            parameters.replace_rows(FREE_ROWS, keep=keep, added=values_of_rows(born, FREE_ROWS), count=len(born))
        adam = Adam(self.backend)
        statistics = GradientStatistics(slots_of(scene) + (0 if born is None else len(born)), self.backend.device)
        last_pass = LastPass()
        settling = Settling(config.least_gain * len(views) / max(1, config.iterations), len(seen))
        tells_every = 1 if self.backend.device.type == "cpu" else 10  # Asking a GPU for the loss waits for it.
        spawned = pruned = iteration = 0
        while iteration < iterations and not (iteration > patch_at and settling.settled):
            iteration += 1
            view = next(order)
            loss = view_loss(
                parameters.scene(scene),
                view,
                backend=self.stepping,
                weights=config.losses,
                voxel_size=0.0,
                track_screen=patching.spawn != "off" and patching.collect_from < iteration <= patch_at,
                watch=watch,
                focus=None if places is None else places[view.index],
            )
            settling.add(view.index, loss.total)
            if iteration < patch_at and settling.settled:
                patch_at = iteration
            if rate is not None:
                loss = replace(loss, total=loss.total + rate.price(parameters.values))
            gradients, screen_gradient = gradients_of(loss, parameters, watch)
            if config.least_gain or iteration > iterations - len(seen):
                last_pass.add(loss, view)
            with watch.stage("optimise"):
                adam.step(parameters, gradients, online_rates(config, (iteration - 1) / iterations))
            if screen_gradient is not None:
                statistics.add(loss.rendering, screen_gradient)
            if iteration == patch_at and "free" in config.dynamic:
                with watch.stage("patch"), torch.no_grad():
                    others = [other for other in seen if other.index != view.index]
                    survivors, spawned = patched(
                        parameters,
                        adam,
                        scene=scene,
                        statistics=statistics,
                        views=[view, *others],
                        frame_index=self.frame_index,
                        room=patching.max_free - still_free,
                        config=patching,
                        backend=self.backend,
                        generator=self.generator,
                    )
                    pruned = int((~survivors).sum())
                    rate = None if rate is None else rate.kept(survivors)
                settling.begin_again()
            if self.on_step is not None and iteration % tells_every == 0:
                free = parameters.values["free_means"].shape[0] + still_free
                self.on_step(Step(iteration, iterations, float(loss.total.detach()), len(scene.anchors), free))
        return FitResult(
            scene=detached(parameters.scene(scene)),
            iterations=iteration,
            train_psnr=last_pass.psnr,
            moving=len(scene.anchors),
            spawned=spawned,
            pruned=pruned,
            seconds=watch.seconds,
            losses=last_pass.terms,
        )


def without_patching(config: OnlineConfig) -> OnlineConfig:
    """The same configuration with no free Gaussians: the paper's baseline of its free-3DG ablation."""
    return replace(config, patching=replace(config.patching, spawn="off"))

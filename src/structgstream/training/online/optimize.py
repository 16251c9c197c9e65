# SPDX-License-Identifier: Apache-2.0
"""The iterations of a frame after the first: rendering loss, rate term, smoothness, and patching once (paper, section
Methods).

As in the paper::

    initial state --> [ 50 steps ] --> prune free, spawn free --> [ 50 steps ] --> scene(t)
                           |                   ^
                           '-- view-space gradients by id

With motion selection (``compact``) free Gaussians are spawned before (``spawn.py``); in the iterations they are only
pruned, once.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch

from structgstream.codec.fields.quantization import RateTerm
from structgstream.kernels.backend import Backend
from structgstream.scene.scene import Scene
from structgstream.scene.state import FieldName, ParameterName, fields_of
from structgstream.training.losses import GradientStatistics
from structgstream.training.online.config import OnlineConfig, online_rates
from structgstream.training.online.iterations import OnlineHooks, StartingPoint, minimize_natively, unknown_natively
from structgstream.training.online.measure import slot_count
from structgstream.training.online.patching import FreeSet
from structgstream.training.online.smoothness import MotionSmoothness
from structgstream.training.optim import Adam, LastPass, MeanOfSteps, Schedule, minimize
from structgstream.training.parameters import FREE_ROWS, Parameters, detached, parameters_of_fields, values_of_rows
from structgstream.training.result import FitResult, StepListener, Stopwatch
from structgstream.training.views import shuffled_views

SHARED_FIELDS: frozenset[FieldName] = frozenset(fields_of("shared", "camera"))
"""Shared fields are trained only in frames in which everything is, because static anchors depend on them."""


@dataclass(frozen=True)
class FrameOptimizer:
    """Optimises the initial state of one frame.

    Args:
        config: of online frames.
        backend: the compute back-end.
        frame_index: of the frame, for the identities of spawned Gaussians.
        generator: of all random numbers.
        watch: gets seconds by stage.
        steps: quantization steps (Note [Bins]).
        on_step: called after every iteration, or every tenth of native ones; None for none.
    """

    config: OnlineConfig
    backend: Backend
    frame_index: int
    generator: torch.Generator
    watch: Stopwatch
    steps: Mapping[str, float]
    on_step: StepListener | None = None

    def run(self, start: StartingPoint) -> FitResult[Scene]:
        """The scene of ``start``, fitted to its pictures."""
        config, seen, split = self.config, start.seen, start.split
        if (sampling := start.scene.sampling) is not None:
            held = sampling.intervals(start.scene.anchors.positions + start.displacements[: len(start.scene.anchors)])
            start = replace(start, scene=replace(start.scene, anchor_intervals=held))
        # Each view is used as often as in a frame in which everything is trained.
        iterations = math.ceil(config.iterations * config.effort(start.fast_share) * len(seen) / len(start.views))
        rests = rest_every(config.motion.rest_every, views=len(seen), iterations=iterations)

        parameters, rate_term = self._parameters(start)
        adam = Adam(self.backend, parameters.values)
        _displace_parameters(parameters, adam, start)
        free_set = FreeSet(
            config=config.patching,
            template=start.scene,
            parameters=parameters,
            adam=adam,
            statistics=GradientStatistics(slot_count(start.scene) + len(start.new_free), self.backend.device),
            views=seen,
            frame_index=self.frame_index,
            room=config.patching.max_free - (0 if split is None else len(split.static.free)),
            backend=self.backend,
            generator=self.generator,
        )
        last_pass = LastPass(iterations - 2 * len(seen) + 1, terms_after=iterations - rests * len(seen))
        average = MeanOfSteps(math.floor(iterations * (1.0 - config.mean_of_last))) if config.mean_of_last else None
        hooks = OnlineHooks(
            start=start,
            parameters=parameters,
            config=config,
            rate_term=rate_term,
            smoothness=MotionSmoothness.of(
                start.known, [view.camera for view in start.views], config=config.smoothness
            ),
            free_set=free_set,
            patch_at=self._patch_at(start),
            patches="free" in config.dynamic,
            last_pass=last_pass,
            backend=self.backend,
            watch=self.watch,
            rest_every=rests,
            average=average,
        )
        schedule = Schedule(iterations, lambda iteration: online_rates(config, (iteration - 1) / iterations))
        samples = shuffled_views(seen, self.generator)
        begin = self.backend.iterations
        if begin is not None and self._runs_natively(start):
            done = minimize_natively(adam, samples, schedule, hooks, begin=begin, on_step=self.on_step)
        else:
            done = minimize(adam, samples, schedule, hooks, watch=self.watch, on_step=self.on_step)
        if average is not None:
            average.apply(parameters.values)
        return FitResult(
            scene=detached(parameters.scene(start.scene)),
            iterations=done,
            train_psnr=last_pass.psnr,
            moving=len(start.scene.anchors),
            spawned=free_set.spawned,
            pruned=free_set.pruned,
            seconds=self.watch.seconds,
            losses=last_pass.terms,
        )

    def _runs_natively(self, start: StartingPoint) -> bool:
        """Whether the back-end's own iterations can run these."""
        patching = self.config.patching
        tracks_screen = patching.spawn != "off" and patching.collect_from < self._patch_at(start)
        splits = None not in (start.active_tiles, start.split)
        return splits and not tracks_screen and not unknown_natively(self.config, start.scene)

    def _patch_at(self, start: StartingPoint) -> int:
        in_all_views = self.config.patching.iteration * self.config.effort(start.fast_share)
        return math.ceil(in_all_views * len(start.seen) / len(start.views))

    def _parameters(self, start: StartingPoint) -> tuple[Parameters, RateTerm | None]:
        """The leaves of the scene, and the rate term of changes since it or since ``start.reference``."""
        config = self.config
        dynamic = config.trained if start.split is None else config.trained.difference(SHARED_FIELDS)
        trained = parameters_of_fields(dynamic)
        steps: dict[ParameterName, float] = {name: self.steps[name] for name in trained if name in self.steps}
        parameters = Parameters.of(start.scene, trained=trained, steps=steps)
        rounding = config.rounding
        weight = rounding.resolved_rate_weight
        if start.reference is None:
            return parameters, RateTerm.of(parameters.values, steps, weight=weight, free=rounding.free_priced)
        known = Parameters.of(start.reference, trained=trained, steps=steps)
        return parameters, RateTerm.of(known.values, steps, weight=weight, free=False)


def rest_every(most: int, *, views: int, iterations: int) -> int:
    """At most ``most`` (``MotionConfig.rest_every``), and so few that each of the views draws all of its tiles once."""
    return max(1, min(most, iterations // max(views, 1)))


def _displace_parameters(parameters: Parameters, adam: Adam[ParameterName], start: StartingPoint) -> None:
    """Set the leaves to the frame's initial state, with the spawned Gaussians."""
    values, anchors = parameters.values, len(start.scene.anchors)
    if values["anchor_positions"].requires_grad:
        values["anchor_positions"].data += start.displacements[:anchors]
    if not values["free_means"].requires_grad:
        return
    values["free_means"].data += start.displacements[anchors:]
    if len(start.new_free):
        keep = torch.ones(len(start.scene.free), dtype=torch.bool)
        parameters.births = torch.cat([parameters.births, start.new_free.births])
        adam.replace_rows(values_of_rows(start.new_free, FREE_ROWS), keep=keep)

# SPDX-License-Identifier: Apache-2.0
"""The iterations of a frame after the first: rendering loss, rate term, smoothness, and patching once (paper, section
Methods).

::

    initial state --> [ 50 steps ] --> prune free, spawn free --> [ 50 steps ] --> scene(t)
                           |                   ^
                           '-- view-space gradients by id
"""

import math
from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from structgstream.codec.fields.quantization import RateTerm
from structgstream.kernels.backend import Backend, nonblocking
from structgstream.kernels.cuda_tiles import PairBudget, run_with_pair_budget
from structgstream.scene.active_tiles import ActiveTiles
from structgstream.scene.free import FreeGaussians
from structgstream.scene.scene import Scene
from structgstream.scene.state import FieldName, ParameterName, fields_of
from structgstream.training.losses import GradientStatistics, LossWeights, SceneLoss, view_loss, with_term
from structgstream.training.online.config import OnlineConfig, online_rates
from structgstream.training.online.measure import slot_count
from structgstream.training.online.patching import FreeSet
from structgstream.training.online.smoothness import MotionSmoothness
from structgstream.training.online.split import DynamicSplit
from structgstream.training.optim import Adam, Hooks, LastPass, MeanOfSteps, Schedule, minimize
from structgstream.training.parameters import FREE_ROWS, Parameters, detached, parameters_of_fields, values_of_rows
from structgstream.training.result import FitResult, StepListener, Stopwatch
from structgstream.training.views import View, shuffled_views

SHARED_FIELDS: frozenset[FieldName] = frozenset(fields_of("shared", "camera"))
"""Shared fields are trained only in frames in which everything is, because static anchors depend on them."""


@dataclass(frozen=True)
class StartingPoint:
    """Initial state of a frame's optimisation.

    Args:
        scene: the whole scene, or the dynamic part of ``split``.
        views: the pictures.
        displacements: ``[M + F, 3]`` initial displacements of its primitives (Note [Primitives]).
        split: of which the scene is the moving part; None for a whole scene.
        active_tiles: by view index, the tiles that the scene reaches; None for whole pictures of all views.
        new_free: free Gaussians to add.
        reference: anchors as in ``scene``, from whose values changes and motion are priced; free Gaussians then have no
            price. None: since ``scene``.
    """

    scene: Scene
    views: list[View]
    displacements: Tensor
    split: DynamicSplit | None = None
    active_tiles: Mapping[int, ActiveTiles] | None = None
    new_free: FreeGaussians | None = None
    reference: Scene | None = None

    @property
    def known(self) -> Scene:
        """The scene against which changes and displacements are penalised."""
        return self.scene if self.reference is None else self.reference

    @property
    def seen(self) -> list[View]:
        """The views in which the scene is visible."""
        return (
            self.views
            if self.active_tiles is None
            else [view for view in self.views if view.index in self.active_tiles]
        )

    def with_own_pictures(self) -> "StartingPoint":
        """The same with copies of the pictures that iterations draw into."""
        if self.active_tiles is None:
            return self
        copies = {i: replace(active, picture=active.picture.clone()) for i, active in self.active_tiles.items()}
        return replace(self, active_tiles=copies)


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
        on_step: called after every iteration; None for none.
    """

    config: OnlineConfig
    backend: Backend
    frame_index: int
    generator: torch.Generator
    watch: Stopwatch
    steps: Mapping[str, float]
    on_step: StepListener | None = None

    def run(self, start: StartingPoint) -> FitResult[Scene]:
        """The scene of ``start``, fitted to its pictures; on a GPU again with more memory if that was short."""
        if self.backend.name != "cuda":
            return self._run(start, self.backend)
        random = self.generator.get_state()
        whole = start.scene if start.split is None else start.split.whole
        slots = slot_count(whole) + _length(start.new_free)

        def attempt(budget: PairBudget) -> FitResult[Scene]:
            # What an attempt has drawn and counted must not reach the next one.
            self.generator.set_state(random)
            return self._run(start.with_own_pictures(), nonblocking(self.backend, budget))

        # The host can run ahead of a GPU because no iteration synchronises.
        return run_with_pair_budget(attempt, capacity=max(1 << 18, 8 * slots), device=self.backend.device)

    def _run(self, start: StartingPoint, backend: Backend) -> FitResult[Scene]:
        config, seen, split = self.config, start.seen, start.split
        if (sampling := start.scene.sampling) is not None:
            held = sampling.intervals(start.scene.anchors.positions + start.displacements[: len(start.scene.anchors)])
            start = replace(start, scene=replace(start.scene, anchor_intervals=held))
        # Each view is used as often as in a frame in which everything is trained.
        iterations = math.ceil(config.iterations * len(seen) / len(start.views))
        rests = rest_every(config.motion.rest_every, views=len(seen), iterations=iterations)

        parameters, rate_term = self._parameters(start)
        adam = Adam(self.backend, parameters.values)
        _displace_parameters(parameters, adam, start)
        free_set = FreeSet(
            config=config.patching,
            template=start.scene,
            parameters=parameters,
            adam=adam,
            statistics=GradientStatistics(slot_count(start.scene) + _length(start.new_free), self.backend.device),
            views=seen,
            frame_index=self.frame_index,
            room=config.patching.max_free - (0 if split is None else len(split.static.free)),
            backend=self.backend,
            generator=self.generator,
        )
        last_pass = LastPass(iterations - len(seen), terms_after=iterations - rests * len(seen))
        average = MeanOfSteps(math.floor(iterations * (1.0 - config.mean_of_last))) if config.mean_of_last else None
        hooks = OnlineHooks(
            start=start,
            parameters=parameters,
            losses=config.losses,
            rate_term=rate_term,
            smoothness=MotionSmoothness.of(
                start.known, [view.camera for view in start.views], config=config.smoothness
            ),
            free_set=free_set,
            patch_at=math.ceil(config.patching.iteration * len(seen) / len(start.views)),
            patches="free" in config.dynamic,
            last_pass=last_pass,
            backend=backend,
            watch=self.watch,
            rest_every=rests,
            iterations=iterations,
            average=average,
        )
        recorder = None if backend.recorder is None else backend.recorder()
        done = minimize(
            adam,
            shuffled_views(seen, self.generator),
            Schedule(iterations, lambda iteration: online_rates(config, (iteration - 1) / iterations)),
            hooks,
            watch=self.watch,
            on_step=self.on_step,
            recorder=recorder,
        )
        if average is not None:
            average.apply(parameters.values)
        return FitResult(
            scene=detached(parameters.scene(start.scene)),
            iterations=done,
            train_psnr=last_pass.psnr,
            moving=len(start.scene.anchors),
            spawned=free_set.spawned,
            pruned=free_set.pruned,
            counts={} if recorder is None else {"recorded": len(recorder), "replayed": recorder.replays},
            seconds=self.watch.seconds,
            losses=last_pass.terms,
        )

    def _parameters(self, start: StartingPoint) -> tuple[Parameters, RateTerm | None]:
        """The leaves of the scene, and the rate term of changes since it or since ``start.reference``."""
        config = self.config
        dynamic = config.trained if start.split is None else config.trained.difference(SHARED_FIELDS)
        trained = parameters_of_fields(dynamic)
        steps: dict[ParameterName, float] = {name: self.steps[name] for name in trained if name in self.steps}
        parameters = Parameters.of(start.scene, trained=trained, steps=steps)
        rounding = config.rounding
        known, free = parameters, rounding.free_priced
        if start.reference is not None:
            known, free = Parameters.of(start.reference, trained=trained, steps=steps), False
        return parameters, RateTerm.of(known.values, steps, weight=rounding.resolved_rate_weight, free=free)


def rest_every(most: int, *, views: int, iterations: int) -> int:
    """At most ``most`` (``MotionConfig.rest_every``), and so few that each of the views draws all of its tiles once."""
    return max(1, min(most, iterations // max(views, 1)))


def _length(free: FreeGaussians | None) -> int:
    return 0 if free is None else len(free)


def _displace_parameters(parameters: Parameters, adam: Adam[ParameterName], start: StartingPoint) -> None:
    """Set the leaves to the frame's initial state, with the spawned Gaussians."""
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


@dataclass
class OnlineHooks(Hooks[View, SceneLoss]):
    """What an iteration minimises, and what is done between iterations.

    Args:
        start: the initial state.
        parameters: of the scene.
        losses: weights of the terms.
        rate_term: the price of changing bins; None for none.
        smoothness: the price of incoherent motion; None for none.
        free_set: of the free Gaussians.
        patch_at: the iteration after which free Gaussians are pruned and spawned.
        patches: whether they are.
        last_pass: gets the result of each view; loss terms of visits of all its tiles only.
        backend: the compute back-end.
        watch: seconds by stage.
        rest_every: tiles in which nothing has changed are drawn every this many times that a view is.
        visits: by view index, how often it was drawn.
        average: gets the leaves of each iteration; None for none.
        iterations: of the frame, at most; to know which of them are worth recording. 0: none is.
        recorded: keys that :meth:`repeats` has given.
    """

    start: StartingPoint
    parameters: Parameters
    losses: LossWeights
    rate_term: RateTerm | None
    smoothness: MotionSmoothness | None
    free_set: FreeSet
    patch_at: int
    patches: bool
    last_pass: LastPass
    backend: Backend
    watch: Stopwatch
    rest_every: int = 1
    visits: dict[int, int] = field(default_factory=dict)
    average: MeanOfSteps | None = None
    iterations: int = 0
    recorded: set[Hashable] = field(default_factory=set)

    def loss(self, iteration: int, sample: View) -> SceneLoss:
        active = self._active_tiles_of(sample)
        loss = view_loss(
            self.parameters.scene(self.start.scene),
            sample,
            backend=self.backend,
            weights=self.losses,
            track_screen=self._tracks_screen(iteration),
            watch=self.watch,
            active=replace(active, tiles=active.changed) if active is not None and self._rests(sample) else active,
            background=None if active is None else active.background,
        )
        # Tiles that are not drawn now hold their last drawing.
        return self._with_regularizers(replace(loss, active=active))

    def _with_regularizers(self, loss: SceneLoss) -> SceneLoss:
        values = self.parameters.values
        if self.smoothness is not None:
            difference = self.smoothness.difference(values["anchor_positions"], self.backend)
            loss = with_term(loss, "smoothness", difference, weight=self.smoothness.weight)
        if self.rate_term is None:
            return loss
        return replace(loss, total=loss.total + self.rate_term.value(values, self.backend))

    def _active_tiles_of(self, sample: View) -> ActiveTiles | None:
        return None if self.start.active_tiles is None else self.start.active_tiles[sample.index]

    def _alternates(self, sample: View) -> bool:
        """Whether some visits of the view are without the tiles in which nothing has changed."""
        active = self._active_tiles_of(sample)
        return active is not None and active.changed is not None and self.rest_every > 1

    def _rests(self, sample: View) -> bool:
        """Whether this visit of the view is without the tiles in which nothing has changed."""
        return self._alternates(sample) and (self.visits.get(sample.index, 0) + 1) % self.rest_every != 0

    def _tracks_screen(self, iteration: int) -> bool:
        patching = self.free_set.config
        return patching.spawn != "off" and patching.collect_from < iteration <= self.patch_at

    def repeats(self, iteration: int, sample: View) -> Hashable | None:
        """Visits of a view that draw the same tiles, until rows of free Gaussians come or go."""
        active, alternates, rests = self._active_tiles_of(sample), self._alternates(sample), self._rests(sample)
        key = sample.index, rests, self.free_set.version
        if key not in self.recorded:
            # The other visits of a view follow each other; those of all tiles are ``rest_every`` visits apart.
            visits_left = (self.iterations - iteration) // len(self.start.seen)
            if self._tracks_screen(iteration) or visits_left < (self.rest_every if alternates and not rests else 1):
                return None
            for tiles in () if active is None else (active.tiles, active.changed):
                if tiles is not None:
                    tiles.pixels()  # Masks are made at their first use, which must not be part of a recording.
            self.recorded.add(key)
        return key

    def after_step(self, iteration: int, sample: View, loss: SceneLoss, screen_gradient: Tensor | None) -> None:
        rests = self._rests(sample)
        self.visits[sample.index] = self.visits.get(sample.index, 0) + 1
        self.last_pass.add(iteration, loss, sample, comparable=not rests)
        if screen_gradient is not None:
            self.free_set.statistics.add(loss.rendering, screen_gradient)
        if iteration == self.patch_at and self.patches:
            with self.watch.stage("patch"), torch.no_grad():
                version, survivors = self.free_set.version, self.free_set.patch(sample)
                if self.rate_term is not None and self.free_set.version != version:
                    self.rate_term = self.rate_term.after_pruning(survivors)
        if self.average is not None:
            self.average.add(iteration, self.parameters.values)

    def counts(self) -> tuple[int, int]:
        split = self.start.split
        static = 0 if split is None else len(split.static.free)
        return len(self.start.scene.anchors), len(self.free_set) + static

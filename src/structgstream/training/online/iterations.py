# SPDX-License-Identifier: Apache-2.0
"""The iterations of a frame after the first: their initial state, and two ways to run them.

:class:`OnlineHooks` for ``training.optim.minimize``, in torch, defines the results. Where only a dynamic split is
trained, without view-space gradients, :func:`minimize_natively` takes the back-end's own iterations
(``Backend.iterations``; csrc/cpu/fit.cpp, csrc/cuda/fit_calls.h), without Python between them.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import islice, pairwise

import torch
from torch import Tensor

from structgstream.codec.fields.quantization import RateTerm
from structgstream.kernels.backend import Backend
from structgstream.kernels.values import FitFrame, FitLeaf, FitPlan, FitView, LossFactors
from structgstream.scene.active_tiles import ActiveTiles
from structgstream.scene.free import FreeGaussians
from structgstream.scene.scene import Scene
from structgstream.scene.state import ParameterName
from structgstream.training.losses import SceneLoss, view_loss, with_term
from structgstream.training.online.config import OnlineConfig
from structgstream.training.online.patching import FreeSet
from structgstream.training.online.smoothness import MotionSmoothness
from structgstream.training.online.split import DynamicSplit
from structgstream.training.optim import BETAS, Adam, Hooks, LastPass, MeanOfSteps, Schedule
from structgstream.training.parameters import ANCHOR_ROWS, FREE_ROWS, Parameters, values_of_rows
from structgstream.training.result import Step, StepListener, Stopwatch
from structgstream.training.views import View

LEAVES: tuple[ParameterName, ...] = (
    "anchor_positions",
    "offset_scales",
    "base_scales",
    "anchor_offsets",
    "anchor_features",
    "appearance",
    "free_means",
    "free_log_scales",
    "free_quats",
    "free_logit_opacities",
    "free_colors",
)
"""Parameters that the back-ends' own iterations can train, in the order of ``FitFrame.leaves``."""
NATIVE_LOSSES = frozenset({"l1", "ssim", "volume"})
"""Fields of ``LossWeights`` whose terms the back-ends' own iterations compute."""
NATIVE_SETTINGS = frozenset(
    {
        *("iterations", "extra_iterations", "losses", "rates", "smoothness", "rounding", "mean_of_last"),
        "sampling_filter",
        *("dynamic", "appearance_rank", "patching", "motion", "scene_flow", "spawn", "motion_prior", "exposure"),
    }
)
"""Fields of :class:`OnlineConfig` that the back-ends' own iterations follow, or that do not affect them."""
TERMS = ("l1", "ssim", "volume", "smoothness")
"""The first columns of ``FitPlan.terms``; the last one is the loss: their weighted sum plus the rate term."""
REPORT_INTERVAL = 10
"""Iterations between reports of progress, where a back-end runs them."""


def unknown_natively(config: OnlineConfig, scene: Scene) -> set[str]:
    """Names of what only iterations in torch know: settings and weights that are not zero, rows of the scene."""
    losses = {name: value for name, value in vars(config.losses).items() if not isinstance(value, str)}
    rows = {*values_of_rows(scene.anchors, ANCHOR_ROWS), *values_of_rows(scene.free, FREE_ROWS)}
    return {
        *(name for name, value in vars(config).items() if value and name not in NATIVE_SETTINGS),
        *(name for name, weight in losses.items() if weight and name not in NATIVE_LOSSES),
        *rows.difference(LEAVES),
    }


@dataclass(frozen=True)
class StartingPoint:
    """Initial state of a frame's optimisation.

    Args:
        scene: the whole scene, or the dynamic part of ``split``.
        views: the pictures.
        displacements: ``[M + F, 3]`` initial displacements of its primitives (Note [Primitives]).
        split: of which the scene is the dynamic part; None for a whole scene.
        active_tiles: by view index, the tiles that the scene reaches; None for whole pictures of all views.
        new_free: free Gaussians to add.
        reference: anchors as in ``scene``, from whose values the rate term and smoothness count; it has no free
            Gaussians, so these have no rate term. None: from ``scene``.
        fast_share: share of the scene's primitives that move fast.
    """

    scene: Scene
    views: list[View]
    displacements: Tensor
    split: DynamicSplit | None = None
    active_tiles: Mapping[int, ActiveTiles] | None = None
    new_free: FreeGaussians = field(default_factory=FreeGaussians.empty)
    reference: Scene | None = None
    fast_share: float = 0.0

    @property
    def known(self) -> Scene:
        """The scene against which changes and displacements are penalised."""
        return self.scene if self.reference is None else self.reference

    @property
    def seen(self) -> list[View]:
        """The views in which the scene is visible."""
        active = self.active_tiles
        return self.views if active is None else [view for view in self.views if view.index in active]


@dataclass
class OnlineHooks(Hooks[View, SceneLoss]):
    """What an iteration minimises, and what is done between iterations.

    Args:
        start: the initial state.
        parameters: of the scene.
        config: of online frames.
        rate_term: bits of changes; None for none.
        smoothness: of motion; None for none.
        free_set: of the free Gaussians.
        patch_at: the iteration after which free Gaussians are pruned and spawned.
        patches: whether they are.
        last_pass: gets the result of each view; loss terms of visits of all its tiles only.
        backend: the compute back-end.
        watch: seconds by stage.
        rest_every: tiles in which nothing has changed are drawn every this many times that a view is.
        visits: by view index, how often it was drawn.
        average: gets the leaves of each iteration; None for none.
    """

    start: StartingPoint
    parameters: Parameters
    config: OnlineConfig
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

    def loss(self, iteration: int, sample: View) -> SceneLoss:
        active = self.active_tiles_of(sample)
        loss = view_loss(
            self.parameters.scene(self.start.scene),
            sample,
            backend=self.backend,
            weights=self.config.losses,
            track_screen=self._tracks_screen(iteration),
            watch=self.watch,
            active=replace(active, tiles=active.changed) if active is not None and self._rests(sample) else active,
            background=None if active is None else active.background,
        )
        # Tiles that are not drawn now hold their last drawing.
        return self._with_regularizers(replace(loss, active=active), sample)

    def _with_regularizers(self, loss: SceneLoss, sample: View) -> SceneLoss:
        """``loss``, of the view ``sample``, with the terms that do not depend on its picture."""
        values = self.parameters.values
        if self.smoothness is not None:
            difference = self.smoothness.difference(values["anchor_positions"], self.backend)
            loss = with_term(loss, "smoothness", difference, weight=self.smoothness.weight)
        if self.rate_term is None:
            return loss
        return replace(loss, total=loss.total + self.rate_term.value(values, self.backend))

    def active_tiles_of(self, sample: View) -> ActiveTiles | None:
        """The tiles of the view that the scene reaches; None for whole pictures."""
        return None if self.start.active_tiles is None else self.start.active_tiles[sample.index]

    def _rests(self, sample: View) -> bool:
        """Whether this visit of the view is without the tiles in which nothing has changed."""
        return self.start.active_tiles is not None and (self.visits.get(sample.index, 0) + 1) % self.rest_every != 0

    def _tracks_screen(self, iteration: int) -> bool:
        patching = self.free_set.config
        return patching.spawn != "off" and patching.collect_from < iteration <= self.patch_at

    def after_step(self, iteration: int, sample: View, loss: SceneLoss, screen_gradient: Tensor | None) -> None:
        self.last_pass.add(iteration, loss, sample, comparable=not self.visit(sample))
        if screen_gradient is not None:
            self.free_set.statistics.add(loss.rendering, screen_gradient)
        if iteration == self.patch_at and self.patches:
            self.patch(sample)
        if self.average is not None:
            self.average.add(iteration, self.parameters.values)

    def visit(self, sample: View) -> bool:
        """Counts a visit of the view; whether it was without the tiles in which nothing has changed."""
        rests = self._rests(sample)
        self.visits[sample.index] = self.visits.get(sample.index, 0) + 1
        return rests

    def patch(self, sample: View) -> bool:
        """Prunes and spawns free Gaussians; whether any came or went."""
        with self.watch.stage("patch"), torch.no_grad():
            survivors = self.free_set.patch(sample)
            if self.rate_term is not None and survivors is not None:
                self.rate_term = self.rate_term.after_pruning(survivors)
        return survivors is not None

    def counts(self) -> tuple[int, int]:
        split = self.start.split
        static = 0 if split is None else len(split.static.free)
        return len(self.start.scene.anchors), len(self.free_set) + static


def minimize_natively(
    adam: Adam[ParameterName],
    samples: Iterator[View],
    schedule: Schedule[ParameterName],
    hooks: OnlineHooks,
    *,
    begin: Callable[[FitFrame], Callable[[int, int], None]],
    on_step: StepListener | None,
) -> int:
    """As ``training.optim.minimize`` of a dynamic split without view-space gradients, by the back-end's iterations
    ``begin``."""
    views = list(islice(samples, schedule.iterations))
    plan = _plan(adam, views, schedule, hooks)
    patch_at = hooks.patch_at if hooks.patches and hooks.patch_at <= len(views) else 0
    interval = REPORT_INTERVAL if on_step is not None else max(len(views), 1)
    run = None
    # The back-end runs from one stop to the next: reports, the patching, the end.
    stops = sorted({*range(0, len(views), interval), patch_at, len(views)})
    for first, last in pairwise(stops):
        with hooks.watch.stage("iterations"):
            run = run or begin(_frame(adam, plan, hooks, first))
            run(first, last)
        if hooks.average is not None:
            hooks.average.count(last - max(first, plan.mean_from))
        if last == patch_at and hooks.patch(views[last - 1]):
            run = None  # rows have come or gone
        if on_step is not None:
            on_step(Step(last, len(views), float(plan.terms[last - 1, len(TERMS)]), *hooks.counts()))
    computed = {"l1", "ssim"}
    computed |= {"volume"} if hooks.config.losses.volume else set()
    computed |= {"smoothness"} if hooks.smoothness is not None else set()
    for i, (view, rests) in enumerate(zip(views, plan.rests.tolist(), strict=True)):
        found = {name: value for name, value in zip(TERMS, plan.terms[i], strict=False) if name in computed}
        hooks.last_pass.add_results(i + 1, view.index, found, plan.squared_errors[i], comparable=not rests)
    return len(views)


def _plan(
    adam: Adam[ParameterName], views: list[View], schedule: Schedule[ParameterName], hooks: OnlineHooks
) -> FitPlan:
    count, numbers = len(views), {view.index: n for n, view in enumerate(hooks.start.seen)}
    rates = [[found[name] for name in LEAVES] for found in map(schedule.rates, range(1, count + 1))]
    return FitPlan(
        order=torch.tensor([numbers[view.index] for view in views], dtype=torch.int32),
        rests=torch.tensor([hooks.visit(view) for view in views], dtype=torch.bool),
        rates=torch.tensor(rates, dtype=torch.float64),
        mean_from=count if hooks.average is None else hooks.average.after,
        errors_from=hooks.last_pass.after,
        betas=BETAS,
        eps=adam.eps,
        terms=torch.zeros(count, 5),
        squared_errors=torch.zeros(count, dtype=torch.float64),
    )


def _frame(adam: Adam[ParameterName], plan: FitPlan, hooks: OnlineHooks, done: int) -> FitFrame:
    """The frame from iteration ``done``, with the rows that its leaves have now."""
    scene, rate_term, smoothness, losses = hooks.start.scene, hooks.rate_term, hooks.smoothness, hooks.config.losses
    values = hooks.parameters.values

    def leaf(name: ParameterName) -> FitLeaf | None:
        value = values.get(name)
        if value is None or not value.requires_grad:
            return None if value is None else FitLeaf(value)
        adam.begin(name)
        sums = None if hooks.average is None else hooks.average.sums_of(name, value.detach(), done)
        before = None if rate_term is None else rate_term.before.get(name)
        step = hooks.parameters.steps.get(name, 0.0)
        return FitLeaf(value.detach(), adam.first[name], adam.second[name], sums, before, step)

    sampling, free_means = scene.sampling, values["free_means"].detach()
    return FitFrame(
        leaves=[leaf(name) for name in LEAVES],
        mlps=scene.mlps,
        basis=None if scene.anchors.appearance is None else scene.appearance_basis,
        distance_input=scene.distance_input,
        anchor_intervals=scene.anchor_intervals,
        # Free Gaussians, too, move by far less than their depth.
        free_intervals=None if sampling is None else sampling.intervals(free_means),
        views=[_view(view, hooks) for view in hooks.start.seen],
        start=None if smoothness is None else smoothness.start,
        neighbours=None if smoothness is None else smoothness.neighbours,
        shares=None if smoothness is None else smoothness.shares,
        factors=LossFactors(
            losses.l1,
            losses.ssim,
            losses.volume,
            losses.volume_reduction == "mean",
            0.0 if rate_term is None else rate_term.weight_per_bit,
            *(() if smoothness is None else (smoothness.weight, smoothness.pixel, smoothness.slack_pixels)),
        ),
        plan=plan,
    )


def _view(view: View, hooks: OnlineHooks) -> FitView:
    scene, active = hooks.start.scene, hooks.active_tiles_of(view)
    assert active is not None
    return FitView(
        viewport=view.camera.viewport(scene.anchors.positions),
        picture=view.image,
        mask=view.mask,
        tiles=active.tiles,
        changed=active.changed,
        gains=scene.camera_color.gains[view.index],
        biases=scene.camera_color.biases[view.index],
        background=active.background,
        image=active.picture,
        static=active.static,
    )

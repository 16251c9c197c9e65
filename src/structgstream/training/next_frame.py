# SPDX-License-Identifier: Apache-2.0
"""Iterations of a frame after the first: loss with the price of bits, patching, early stopping."""

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from structgstream.kernels.backend import Backend
from structgstream.scene.focus import Focus
from structgstream.scene.free import FreeGaussians
from structgstream.scene.scene import Scene
from structgstream.training.coherence import MotionCoherence
from structgstream.training.early_stopping import EarlyStopping
from structgstream.training.last_pass import LastPass
from structgstream.training.losses import LossWeights
from structgstream.training.mean_of_steps import MeanOfSteps
from structgstream.training.optimize import Hooks
from structgstream.training.parameters import Parameters
from structgstream.training.partition import Partition
from structgstream.training.population import Population
from structgstream.training.price import BitPrice
from structgstream.training.step import SceneLoss, view_loss, with_term
from structgstream.training.stopwatch import Stopwatch
from structgstream.training.views import View


@dataclass(frozen=True)
class StartingPoint:
    """Initial state of a frame's optimisation.

    Args:
        scene: the whole scene, or the moving part of ``partition``.
        views: the pictures.
        displacements: ``[M + F, 3]`` initial displacements of its movers (Note [Movers]).
        partition: of which the scene is the moving part; None for a whole scene.
        focuses: by view index, the focus on the scene; None for whole pictures of all views.
        new_free: free Gaussians to add.
        reference: anchors as in ``scene``, from whose values changes and motion are priced; free Gaussians then have no
            price. None: since ``scene``.
    """

    scene: Scene
    views: list[View]
    displacements: Tensor
    partition: Partition | None = None
    focuses: Mapping[int, Focus] | None = None
    new_free: FreeGaussians | None = None
    reference: Scene | None = None

    @property
    def known(self) -> Scene:
        """What changes and motion are counted from."""
        return self.scene if self.reference is None else self.reference

    @property
    def seen(self) -> list[View]:
        """The views in which the scene is visible."""
        return self.views if self.focuses is None else [view for view in self.views if view.index in self.focuses]


@dataclass(frozen=True)
class PricedLoss(SceneLoss):
    """A view's loss with the prices of motion and bits.

    Args:
        unpriced: ``[]`` the total without the prices.
    """

    unpriced: Tensor

    def detached(self) -> "PricedLoss":
        return replace(super().detached(), unpriced=self.unpriced.detach())


@dataclass
class NextFrameHooks(Hooks[View, PricedLoss]):
    """Hooks of a later frame: the loss with the price of bits, patching once, and early stopping.

    Args:
        start: the initial state.
        parameters: of the scene.
        losses: weights of the terms.
        bit_price: the price of changing bins; None for none.
        coherence: the price of incoherent motion; None for none.
        population: of the free Gaussians.
        early_stopping: early stopping.
        patch_at: the iteration after which free Gaussians are pruned and spawned, unless the frame stops before.
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
    bit_price: BitPrice | None
    coherence: MotionCoherence | None
    population: Population
    early_stopping: EarlyStopping
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

    def loss(self, iteration: int, sample: View) -> PricedLoss:
        focus = self._focus(sample)
        loss = view_loss(
            self.parameters.scene(self.start.scene),
            sample,
            backend=self.backend,
            weights=self.losses,
            voxel_size=0.0,
            track_screen=self._tracks_screen(iteration),
            watch=self.watch,
            focus=replace(focus, tiles=focus.changed) if focus is not None and self._rests(sample) else focus,
            background=None if focus is None else focus.background,
        )
        loss = PricedLoss(**vars(loss), unpriced=loss.total)
        # Tiles that are not drawn now hold their last drawing.
        return self._with_prices(replace(loss, focus=focus))

    def _with_prices(self, loss: PricedLoss) -> PricedLoss:
        values = self.parameters.values
        if self.coherence is not None:
            difference = self.coherence.difference(values["anchor_positions"], self.backend)
            loss = with_term(loss, "coherence", difference, weight=self.coherence.weight)
        if self.bit_price is None:
            return loss
        return replace(loss, total=loss.total + self.bit_price.price(values, self.backend))

    def _focus(self, sample: View) -> Focus | None:
        return None if self.start.focuses is None else self.start.focuses[sample.index]

    def _alternates(self, sample: View) -> bool:
        """Whether some visits of the view are without the tiles in which nothing has changed."""
        focus = self._focus(sample)
        return focus is not None and focus.changed is not None and self.rest_every > 1

    def _rests(self, sample: View) -> bool:
        """Whether this visit of the view is without the tiles in which nothing has changed."""
        return self._alternates(sample) and (self.visits.get(sample.index, 0) + 1) % self.rest_every != 0

    def _tracks_screen(self, iteration: int) -> bool:
        patching = self.population.config
        return patching.spawn != "off" and patching.collect_from < iteration <= self.patch_at

    def repeats(self, iteration: int, sample: View) -> Hashable | None:
        """Visits of a view that draw the same tiles, until rows of free Gaussians come or go."""
        focus, alternates, rests = self._focus(sample), self._alternates(sample), self._rests(sample)
        key = sample.index, rests, self.population.version
        if key not in self.recorded:
            # The other visits of a view follow each other; those of all tiles are ``rest_every`` visits apart.
            visits_left = (self.iterations - iteration) // len(self.start.seen)
            if self._tracks_screen(iteration) or visits_left < (self.rest_every if alternates and not rests else 1):
                return None
            for tiles in () if focus is None else (focus.tiles, focus.changed):
                if tiles is not None:
                    tiles.pixels()  # Masks are made at their first use, which must not be part of a recording.
            self.recorded.add(key)
        return key

    def after_step(self, iteration: int, sample: View, loss: PricedLoss, screen_gradient: Tensor | None) -> None:
        # A loss over other tiles than in most visits cannot be compared with theirs.
        rests = self._rests(sample)
        if rests or not self._alternates(sample):
            self.early_stopping.add(sample.index, loss.unpriced)
        self.visits[sample.index] = self.visits.get(sample.index, 0) + 1
        self.last_pass.add(iteration, loss, sample, comparable=not rests)
        if iteration < self.patch_at and self.early_stopping.should_stop:
            self.patch_at = iteration
        if screen_gradient is not None:
            self.population.statistics.add(loss.rendering, screen_gradient)
        if iteration == self.patch_at and self.patches:
            with self.watch.stage("patch"), torch.no_grad():
                version, survivors = self.population.version, self.population.patch(sample)
                if self.bit_price is not None and self.population.version != version:
                    self.bit_price = self.bit_price.after_pruning(survivors)
            self.early_stopping.reset()
        if self.average is not None:
            self.average.add(iteration, self.parameters.values)

    def finished(self, iteration: int) -> bool:
        return iteration > self.patch_at and self.early_stopping.should_stop

    def counts(self) -> tuple[int, int]:
        partition = self.start.partition
        still = 0 if partition is None else len(partition.still.free)
        return len(self.start.scene.anchors), len(self.population) + still

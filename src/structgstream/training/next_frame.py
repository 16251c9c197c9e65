# SPDX-License-Identifier: Apache-2.0
"""Iterations of a frame after the first: loss with the price of bits, patching, early stopping."""

from collections.abc import Mapping
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


@dataclass
class NextFrameHooks(Hooks[View, SceneLoss]):
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
        last_pass: gets the result of each view.
        backend: the compute back-end.
        watch: seconds by stage.
        rest_every: tiles in which nothing has changed are drawn every this many times that a view is.
        visits: by view index, how often it was drawn.
        average: gets the leaves of each iteration; None for none.
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

    def loss(self, iteration: int, sample: View) -> SceneLoss:
        patching, focuses = self.population.config, self.start.focuses
        focus = None if focuses is None else focuses[sample.index]
        drawn, comparable = self._drawn_now(focus, sample)
        loss = view_loss(
            self.parameters.scene(self.start.scene),
            sample,
            backend=self.backend,
            weights=self.losses,
            voxel_size=0.0,
            track_screen=patching.spawn != "off" and patching.collect_from < iteration <= self.patch_at,
            watch=self.watch,
            focus=drawn,
            background=None if focus is None else focus.background,
        )
        loss = replace(loss, focus=focus)  # Tiles that are not drawn now hold their last drawing.
        if comparable:
            self.early_stopping.add(sample.index, loss.total)
        if iteration < self.patch_at and self.early_stopping.should_stop:
            self.patch_at = iteration
        loss = self._with_prices(loss)
        self.last_pass.add(iteration, loss, sample)
        return loss

    def _with_prices(self, loss: SceneLoss) -> SceneLoss:
        values = self.parameters.values
        if self.coherence is not None:
            difference = self.coherence.difference(values["anchor_positions"], self.backend)
            loss = with_term(loss, "coherence", difference, weight=self.coherence.weight)
        if self.bit_price is None:
            return loss
        return replace(loss, total=loss.total + self.bit_price.price(values, self.backend))

    def _drawn_now(self, focus: Focus | None, sample: View) -> tuple[Focus | None, bool]:
        """``focus``, in most visits of a view without the tiles in which nothing has changed; and whether the loss can
        be compared with that of the view's other visits."""
        if focus is None or focus.changed is None or self.rest_every == 1:
            return focus, True
        visit = self.visits[sample.index] = self.visits.get(sample.index, 0) + 1
        if visit % self.rest_every == 0:
            return focus, False
        return replace(focus, tiles=focus.changed), True

    def after_step(self, iteration: int, sample: View, loss: SceneLoss, screen_gradient: Tensor | None) -> None:
        if screen_gradient is not None:
            self.population.statistics.add(loss.rendering, screen_gradient)
        if iteration == self.patch_at and self.patches:
            with self.watch.stage("patch"), torch.no_grad():
                survivors = self.population.patch(sample)
                self.bit_price = None if self.bit_price is None else self.bit_price.after_pruning(survivors)
            self.early_stopping.reset()
        if self.average is not None:
            self.average.add(iteration, self.parameters.values)

    def finished(self, iteration: int) -> bool:
        return iteration > self.patch_at and self.early_stopping.should_stop

    def counts(self) -> tuple[int, int]:
        partition = self.start.partition
        still = 0 if partition is None else len(partition.still.free)
        return len(self.start.scene.anchors), len(self.population) + still

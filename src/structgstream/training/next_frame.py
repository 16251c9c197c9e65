# SPDX-License-Identifier: Apache-2.0
"""Iterations of a frame after the first: loss with the price of bits, patching, early stopping."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from structgstream.kernels.backend import Backend
from structgstream.scene.focus import Focus
from structgstream.scene.free import FreeGaussians
from structgstream.scene.scene import Scene
from structgstream.training.last_pass import LastPass
from structgstream.training.losses import LossWeights
from structgstream.training.optimize import Hooks
from structgstream.training.parameters import Parameters
from structgstream.training.partition import Partition
from structgstream.training.population import Population
from structgstream.training.price import Rate
from structgstream.training.settling import Settling
from structgstream.training.step import SceneLoss, view_loss
from structgstream.training.stopwatch import Stopwatch
from structgstream.training.views import View


@dataclass(frozen=True)
class Start:
    """Initial state of a frame's optimisation.

    Args:
        scene: the whole scene, or the moving part of ``partition``.
        views: the pictures.
        ahead: ``[M + F, 3]`` initial displacements of its movers (Note [Movers]).
        partition: of which the scene is the moving part; None for a whole scene.
        places: by view index, the focus on the scene; None for whole pictures of all views.
        born: free Gaussians to add.
    """

    scene: Scene
    views: list[View]
    ahead: Tensor
    partition: Partition | None = None
    places: Mapping[int, Focus] | None = None
    born: FreeGaussians | None = None

    @property
    def seen(self) -> list[View]:
        """The views in which the scene is visible."""
        return self.views if self.places is None else [view for view in self.views if view.index in self.places]


@dataclass
class NextFrame(Hooks[View, SceneLoss]):
    """Hooks of a later frame: the loss with the price of bits, patching once, and early stopping.

    Args:
        start: the initial state.
        parameters: of the scene.
        losses: weights of the terms.
        rate: the price of changing bins; None for none.
        population: of the free Gaussians.
        settling: early stopping.
        patch_at: the iteration after which free Gaussians are pruned and spawned, unless the frame stops before.
        patches: whether they are.
        last_pass: gets the result of each view.
        backend: the compute back-end.
        watch: seconds by stage.
    """

    start: Start
    parameters: Parameters
    losses: LossWeights
    rate: Rate | None
    population: Population
    settling: Settling
    patch_at: int
    patches: bool
    last_pass: LastPass
    backend: Backend
    watch: Stopwatch

    def loss(self, iteration: int, sample: View) -> SceneLoss:
        patching, places = self.population.config, self.start.places
        loss = view_loss(
            self.parameters.scene(self.start.scene),
            sample,
            backend=self.backend,
            weights=self.losses,
            voxel_size=0.0,
            track_screen=patching.spawn != "off" and patching.collect_from < iteration <= self.patch_at,
            watch=self.watch,
            focus=None if places is None else places[sample.index],
        )
        self.settling.add(sample.index, loss.total)
        if iteration < self.patch_at and self.settling.settled:
            self.patch_at = iteration
        self.last_pass.add(iteration, loss, sample)
        return loss if self.rate is None else replace(loss, total=loss.total + self.rate.price(self.parameters.values))

    def after_step(self, iteration: int, sample: View, loss: SceneLoss, screen_gradient: Tensor | None) -> None:
        if screen_gradient is not None:
            self.population.statistics.add(loss.rendering, screen_gradient)
        if iteration == self.patch_at and self.patches:
            with self.watch.stage("patch"), torch.no_grad():
                survivors = self.population.patch(sample)
                self.rate = None if self.rate is None else self.rate.kept(survivors)
            self.settling.begin_again()

    def finished(self, iteration: int) -> bool:
        return iteration > self.patch_at and self.settling.settled

    def counts(self) -> tuple[int, int]:
        partition = self.start.partition
        still = 0 if partition is None else len(partition.still.free)
        return len(self.start.scene.anchors), len(self.population) + still

# SPDX-License-Identifier: Apache-2.0
"""3DGStream's second stage: Gaussians that are added for one frame."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from structgstream.gaussians import Gaussians, concatenate
from structgstream.kernels.backend import Backend
from structgstream.scene.color import CameraColor
from structgstream.training.losses import ViewLoss, picture_loss
from structgstream.training.optim import Adam, Hooks, LastPass, Schedule, leaves, minimize
from structgstream.training.result import StepListener, Stopwatch
from structgstream.training.views import View
from structgstream_studies.peers.gaussians import LOSSES
from structgstream_studies.peers.plain import PlainGaussians, rotated


@dataclass(frozen=True)
class AdditionsConfig:
    """3DGStream's constants; learning rates are fifteen times those of 3DGS."""

    iterations: int = 100
    gradient: float = 1.5e-4
    """Mean norm of the view-space gradient (NDC) above which a Gaussian gets a child."""
    spread: float = 2.0
    """Standard deviation of a child's position, in units of the parent's scales."""
    shrink: float = 0.8
    """A child's scales are the parent's divided by this."""
    opacity: float = 0.1
    interval: int = 20
    """Iterations between prunings of the additions."""
    min_opacity: float = 0.01
    max_extent: float = 0.1
    """Largest size of an addition, as a share of the extent (1.1 rig radii)."""
    means: float = 2.4e-3
    """Learning rate of the means, times the extent."""
    log_scales: float = 7.5e-2
    quats: float = 1.5e-2
    logit_opacities: float = 0.75
    base_colors: float = 3.75e-2
    sh: float = 3.75e-2 / 20


@dataclass(frozen=True)
class Additions:
    """Result of the second stage; no PSNR if nothing was added."""

    added: PlainGaussians
    train_psnr: float | None


def spawned_at(parents: PlainGaussians, config: AdditionsConfig, generator: torch.Generator) -> PlainGaussians:
    """One child for each parent, drawn near it, with its colour."""
    noise = torch.randn(parents.means.shape, generator=generator).to(parents.means)
    quats = torch.zeros_like(parents.quats)
    quats[:, 0] = 1.0
    return replace(
        parents,
        means=parents.means + rotated(parents.quats, noise * config.spread * parents.log_scales.exp()),
        log_scales=parents.log_scales - math.log(config.shrink),
        quats=quats,
        logit_opacities=torch.full_like(parents.logit_opacities, math.log(config.opacity / (1.0 - config.opacity))),
    )


@dataclass
class _AdditionsHooks(Hooks[View, ViewLoss]):
    """Iterations of the second stage: draws the additions with the other Gaussians, and prunes transparent ones."""

    config: AdditionsConfig
    adam: Adam[str]
    base: PlainGaussians
    color: CameraColor
    extent: float
    watch: Stopwatch
    last_pass: LastPass
    _still: dict[int, Gaussians] = field(default_factory=dict)

    @property
    def added(self) -> PlainGaussians:
        """The present additions."""
        return PlainGaussians(**self.adam.values)

    def loss(self, iteration: int, sample: View) -> ViewLoss:
        backend = self.adam.backend
        with self.watch.stage("generate"):
            if sample.index not in self._still:
                self._still[sample.index] = self.base.gaussians(sample.camera, backend)
            drawn = concatenate(self.added.gaussians(sample.camera, backend), self._still[sample.index])
        loss = picture_loss(
            drawn, sample, self.color, backend=backend, weights=LOSSES, track_screen=False, watch=self.watch
        )
        self.last_pass.add(iteration, loss, sample)
        return loss

    def after_step(self, iteration: int, sample: View, loss: ViewLoss, screen_gradient: Tensor | None) -> None:
        if iteration % self.config.interval:
            return
        with self.watch.stage("densify"), torch.no_grad():
            current = self.added
            keep = current.logit_opacities.sigmoid() >= self.config.min_opacity
            keep &= current.log_scales.exp().amax(1) <= self.config.max_extent * self.extent
            self.adam.replace_rows(PlainGaussians.empty(current.degree, current.means).tensors(), keep=keep)

    def counts(self) -> tuple[int, int]:
        return 0, len(self.base) + len(self.adam.values["means"])


def fit_additions(
    start: PlainGaussians,
    base: PlainGaussians,
    color: CameraColor,
    order: Iterator[View],
    *,
    config: AdditionsConfig,
    extent: float,
    views: int,
    backend: Backend,
    watch: Stopwatch,
    before: int,
    on_step: StepListener | None,
) -> Additions:
    """Fit ``start`` together with ``base``, which is fixed.

    Args:
        start: the spawned Gaussians.
        base: all others, as decoded by the receiver.
        color: of the training cameras.
        order: endless iterator over the views.
        config: constants.
        extent: 1.1 rig radii, scene units.
        views: number of training views, over the last of which the PSNR is taken.
        backend: what computes.
        watch: seconds by stage.
        before: iterations of the first stage, for progress.
        on_step: called after every iteration.
    """
    if not len(start):
        return Additions(start, None)
    adam = Adam(backend, leaves(start.tensors()))
    rates = {
        "means": config.means * extent,
        "log_scales": config.log_scales,
        "quats": config.quats,
        "logit_opacities": config.logit_opacities,
        "base_colors": config.base_colors,
        "sh": config.sh,
    }
    last_pass = LastPass(config.iterations - views)
    hooks = _AdditionsHooks(config, adam, base, color, extent, watch, last_pass)
    schedule = Schedule(config.iterations, lambda _: rates, before=before)
    minimize(adam, order, schedule, hooks, watch=watch, on_step=on_step)
    return Additions(hooks.added.detached(), last_pass.psnr)

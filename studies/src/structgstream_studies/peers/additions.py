# SPDX-License-Identifier: Apache-2.0
"""3DGStream's second stage: Gaussians that are added for one frame."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch

from structgstream.gaussians import Gaussians, concatenate
from structgstream.kernels.backend import Backend
from structgstream.scene.color import CameraColor
from structgstream.training.optim import EPS
from structgstream.training.result import Step, StepListener
from structgstream.training.stopwatch import Stopwatch
from structgstream.training.views import View
from structgstream_studies.peers.fitting import LastPsnr, Leaves, gradients_of, picture_loss
from structgstream_studies.peers.plain import PlainGaussians, rotated


@dataclass(frozen=True)
class AdditionsConfig:
    """3DGStream's constants; rates are fifteen times those of 3DGS."""

    iterations: int = 100
    gradient: float = 1.5e-4
    """Mean norm of the view-space gradient in normalised device coordinates from which a Gaussian has a child."""
    spread: float = 2.0
    """A child's place has this many of the parent's standard deviations as its own."""
    shrink: float = 0.8
    """A child's scales are the parent's divided by this."""
    opacity: float = 0.1
    interval: int = 20
    """Additions are pruned this often."""
    min_opacity: float = 0.01
    max_extent: float = 0.1
    """Share of the extent (1.1 rig radii) above which additions are dropped."""
    means: float = 2.4e-3
    """Rate, times the extent."""
    log_scales: float = 7.5e-2
    quats: float = 1.5e-2
    logit_opacities: float = 0.75
    base_colors: float = 3.75e-2
    sh: float = 3.75e-2 / 20


@dataclass(frozen=True)
class Additions:
    """What the second stage gave; no PSNR when there was nothing to add."""

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
    on_step: StepListener | None,
) -> Additions:
    """Fit ``start`` among ``base``, which stays as it is.

    Args:
        start: the spawned Gaussians.
        base: all others, as the receiver has them.
        color: of the training cameras.
        order: views to look at.
        config: constants.
        extent: 1.1 rig radii, scene units.
        views: number of training views, over the last of which the PSNR is taken.
        backend: what computes.
        watch: seconds by stage.
        on_step: called after every iteration.
    """
    if not len(start):
        return Additions(start, None)
    leaves = Leaves.of(start.tensors(), backend=backend, eps=EPS)
    rates = {
        "means": config.means * extent,
        "log_scales": config.log_scales,
        "quats": config.quats,
        "logit_opacities": config.logit_opacities,
        "base_colors": config.base_colors,
        "sh": config.sh,
    }
    still: dict[int, Gaussians] = {}
    last = LastPsnr(config.iterations, views)
    for iteration in range(1, config.iterations + 1):
        view = next(order)
        with watch.stage("generate"):
            if view.index not in still:
                still[view.index] = base.gaussians(view.camera, backend)
            added = PlainGaussians(**leaves.values)
            drawn = concatenate(added.gaussians(view.camera, backend), still[view.index])
        loss = picture_loss(drawn, view, color, backend=backend, track_screen=False, watch=watch)
        last.add(iteration, loss, view)
        if len(added):
            gradients, _ = gradients_of(loss, leaves.values, watch)
            with watch.stage("optimise"):
                leaves.step(gradients, rates)
        if iteration % config.interval == 0:
            with watch.stage("densify"), torch.no_grad():
                current = PlainGaussians(**leaves.values)
                keep = current.logit_opacities.sigmoid() >= config.min_opacity
                keep &= current.log_scales.exp().amax(1) <= config.max_extent * extent
                leaves.replace_rows(PlainGaussians.empty(current.degree, current.means).tensors(), keep=keep)
        if on_step is not None:
            on_step(Step(iteration, config.iterations, float(loss.total.detach()), 0, len(added)))
    return Additions(PlainGaussians(**leaves.values).detached(), last.mean)

# SPDX-License-Identifier: Apache-2.0
import math
from dataclasses import replace

import pytest
import torch

from rigs import arc_rig, random_scene
from structgstream.kernels.backend import reference_backend
from structgstream.scene.state import PAPER_DYNAMIC
from structgstream.training.losses import LossWeights
from structgstream.training.parameters import Parameters, parameters_of_fields
from structgstream.training.step import LastPass, gradients_of, view_loss
from structgstream.training.stopwatch import Stopwatch
from structgstream.training.views import View

CPU = torch.device("cpu")


def loss_of(parameters, scene, **weights):
    view = View(0, arc_rig()["cam01"], torch.full((32, 48, 3), 90, dtype=torch.uint8))
    loss = view_loss(
        parameters.scene(scene),
        view,
        backend=reference_backend(),
        weights=LossWeights(**weights),
        voxel_size=0.01,
        track_screen=True,
        watch=Stopwatch(CPU),
    )
    return loss, view


def test_the_total_is_the_weighted_sum_of_the_papers_terms() -> None:
    scene = random_scene(free=3)
    parameters = Parameters.of(scene, trained=frozenset())
    loss, view = loss_of(parameters, scene, offset_distance=0.005)
    image, target = loss.image, view.image / 255.0
    scales = loss.rendering.gaussians.scales
    expected = (
        (image - target).abs().mean()
        + 0.2 * loss.terms["ssim"]
        + 0.01 * scales.prod(1).mean()
        + 0.005 * loss.terms["offset_distance"]
    )
    assert loss.total.item() == pytest.approx(expected.item(), rel=1e-5)


def test_weights_of_zero_are_not_computed() -> None:
    scene = random_scene()
    loss, _ = loss_of(Parameters.of(scene, trained=frozenset()), scene, volume=0.0)
    assert set(loss.terms) == {"l1", "ssim"}


def test_gradients_reach_exactly_the_trained_parameters() -> None:
    scene = random_scene(free=3)
    parameters = Parameters.of(scene, trained=parameters_of_fields(PAPER_DYNAMIC))
    loss, _ = loss_of(parameters, scene)
    gradients, screen = gradients_of(loss, parameters, Stopwatch(CPU))
    assert set(gradients) == parameters_of_fields(PAPER_DYNAMIC)
    assert screen is not None
    assert screen.shape == (len(loss.rendering.gaussians), 2)
    assert all(gradient.abs().sum() > 0 for gradient in gradients.values())


def test_a_view_that_shows_nothing_has_no_gradients() -> None:
    scene = random_scene(free=0)
    opaque = scene.mlps.opacity
    hidden = opaque._replace(w2=torch.zeros_like(opaque.w2), b2=torch.full_like(opaque.b2, -1.0))
    scene = replace(scene, mlps=scene.mlps._replace(opacity=hidden))
    parameters = Parameters.of(scene, trained=parameters_of_fields(PAPER_DYNAMIC))
    loss, _ = loss_of(parameters, scene, volume=0.0)
    assert len(loss.rendering.gaussians) == 0
    gradients, screen = gradients_of(loss, parameters, Stopwatch(CPU))
    assert all(not gradient.any() for gradient in gradients.values())
    assert screen is None or not len(screen)


def test_the_last_pass_reports_psnr_in_decibels() -> None:
    scene = random_scene()
    loss, view = loss_of(Parameters.of(scene, trained=frozenset()), scene)
    last = LastPass()
    assert math.isnan(last.psnr)
    last.add(loss, view)
    error = (loss.image.clamp(0, 1) - view.image / 255.0).square().mean().item()
    assert last.psnr == pytest.approx(-10 * math.log10(error), abs=1e-4)
    assert last.terms["l1"] == pytest.approx(loss.terms["l1"].item())

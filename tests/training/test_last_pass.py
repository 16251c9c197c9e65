# SPDX-License-Identifier: Apache-2.0
import math

import pytest
import torch

from structgstream.scene.color import CameraColor
from structgstream.training.losses import LossWeights, ViewLoss, picture_loss
from structgstream.training.optim import LastPass
from structgstream.training.result import Stopwatch
from structgstream.training.views import View
from tests.support.backends import quickest_backend
from tests.support.rigs import arc_rig, random_scene

BACKEND = quickest_backend()


def loss_of(grey: int, index: int = 0) -> tuple[ViewLoss, View]:
    scene, view = random_scene(), View(index, arc_rig()["cam01"], torch.full((32, 48, 3), grey, dtype=torch.uint8))
    loss = picture_loss(
        scene.gaussians(view.camera, BACKEND),
        view,
        CameraColor.identity(3, scene.anchors.positions),
        backend=BACKEND,
        weights=LossWeights(),
        track_screen=False,
        watch=Stopwatch(),
    )
    return loss, view


def psnr(loss: ViewLoss, view: View) -> float:
    corrected = (loss.rendering.image * loss.gains + loss.biases).clamp(0, 1)
    return -10 * math.log10((corrected - view.image / 255.0).square().mean().item())


def test_the_last_pass_reports_psnr_in_decibels_and_terms() -> None:
    (dark, first), (bright, second) = loss_of(90), loss_of(200, index=1)
    last = LastPass()
    assert math.isnan(last.psnr)
    last.add(1, dark, first)
    assert last.psnr == pytest.approx(psnr(dark, first), abs=1e-4)
    last.add(2, bright, second)
    assert last.psnr == pytest.approx((psnr(dark, first) + psnr(bright, second)) / 2, abs=1e-4)
    assert last.terms["l1"] == pytest.approx((dark.terms["l1"].item() + bright.terms["l1"].item()) / 2)


def test_terms_of_other_tiles_are_left_out() -> None:
    """A visit of changed tiles alone has another l1; the last visit of all of them counts."""
    (dark, view), (bright, _) = loss_of(90), loss_of(200)
    last = LastPass(after=4, terms_after=2)
    last.add(2, bright, view)
    assert last.terms == {}
    last.add(3, bright, view)
    last.add(5, dark, view, comparable=False)
    assert last.terms["l1"] == pytest.approx(bright.terms["l1"].item())
    assert last.psnr == pytest.approx(psnr(dark, view), abs=1e-4)


def test_a_view_counts_once_and_what_came_before_does_not() -> None:
    (dark, view), (bright, _) = loss_of(90), loss_of(200)
    last = LastPass(after=4)
    last.add(4, bright, view)
    assert math.isnan(last.psnr)
    last.add(5, bright, view)
    last.add(6, dark, view)
    assert last.psnr == pytest.approx(psnr(dark, view), abs=1e-4)

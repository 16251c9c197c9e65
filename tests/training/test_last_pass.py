# SPDX-License-Identifier: Apache-2.0
import math

import pytest

from structgstream.training.losses import ViewLoss
from structgstream.training.optim import LastPass
from structgstream.training.parameters import Parameters
from structgstream.training.views import View
from tests.support.rigs import random_scene
from tests.training.test_step import loss_of

SCENE = random_scene()
PARAMETERS = Parameters.of(SCENE, trained=frozenset())


def psnr(loss: ViewLoss, view: View) -> float:
    corrected = (loss.rendering.image * loss.gains + loss.biases).clamp(0, 1)
    return -10 * math.log10((corrected - view.image / 255.0).square().mean().item())


def test_the_last_pass_reports_psnr_in_decibels_and_terms() -> None:
    dark, first = loss_of(PARAMETERS, SCENE, grey=90)
    bright, second = loss_of(PARAMETERS, SCENE, grey=200, index=1)
    last = LastPass()
    assert math.isnan(last.psnr)
    last.add(1, dark, first)
    assert last.psnr == pytest.approx(psnr(dark, first), abs=1e-4)
    last.add(2, bright, second)
    assert last.psnr == pytest.approx((psnr(dark, first) + psnr(bright, second)) / 2, abs=1e-4)
    assert last.terms["l1"] == pytest.approx((dark.terms["l1"].item() + bright.terms["l1"].item()) / 2)


def test_terms_of_other_tiles_are_left_out() -> None:
    """A visit of changed tiles alone has another l1; the last visit of all of them counts."""
    (dark, view), (bright, _) = (loss_of(PARAMETERS, SCENE, grey=grey) for grey in (90, 200))
    last = LastPass(after=4, terms_after=2)
    last.add(2, bright, view)
    assert last.terms == {}
    last.add(3, bright, view)
    last.add(5, dark, view, comparable=False)
    assert last.terms["l1"] == pytest.approx(bright.terms["l1"].item())
    assert last.psnr == pytest.approx(psnr(dark, view), abs=1e-4)


def test_a_view_counts_once_and_what_came_before_does_not() -> None:
    (dark, view), (bright, _) = (loss_of(PARAMETERS, SCENE, grey=grey) for grey in (90, 200))
    last = LastPass(after=4)
    last.add(4, bright, view)
    assert math.isnan(last.psnr)
    last.add(5, bright, view)
    last.add(6, dark, view)
    assert last.psnr == pytest.approx(psnr(dark, view), abs=1e-4)

# SPDX-License-Identifier: Apache-2.0
"""Scores over time in closed form, and with the exact flow of a synthetic capture."""

import numpy as np
import pytest

from structgstream.evaluation.optional_metrics import FlowField, flicker, warping_error
from structgstream.flow import inside

WIDTH, HEIGHT, FOCAL, DISTANCE = 96, 64, 80.0, 4.0


def noise(seed: int = 0, height: int = 12, width: int = 16) -> np.ndarray:
    return np.random.default_rng(seed).integers(20, 200, (height, width, 3)).astype(np.uint8)


def field(dx: float, dy: float, height: int = 12, width: int = 16) -> FlowField:
    offsets = np.broadcast_to(np.array([dx, dy], np.float32), (height, width, 2)).copy()
    return FlowField(offsets, inside(offsets))


def error_of(now: np.ndarray, before: np.ndarray, field: FlowField) -> float:
    """E_warp where some pixel is seen."""
    error = warping_error(now, before, field)
    assert error is not None
    return error


def test_a_picture_that_moves_with_its_flow_has_no_error() -> None:
    before = noise()
    now = np.roll(before, (1, 3), (0, 1))
    assert warping_error(now, before, field(-3, -1)) == pytest.approx(0.0, abs=1e-10)
    assert error_of(now, before, field(0, 0)) > 1e-2


def test_a_change_of_brightness_is_its_square() -> None:
    before = noise()
    assert warping_error(before + np.uint8(20), before, field(0, 0)) == pytest.approx((20 / 255) ** 2, rel=1e-6)


def test_only_seen_pixels_count() -> None:
    before, now = noise(), noise()
    now[3, 4] = 255 - now[3, 4]
    still = field(0, 0)
    assert error_of(now, before, still) > 0
    still.seen[3, 4] = False
    assert warping_error(now, before, still) == pytest.approx(0.0, abs=1e-10)
    still.seen[:] = False
    assert warping_error(now, before, still) is None


def test_flicker_is_the_mean_change_of_still_pixels_in_levels() -> None:
    before = noise()
    now, still = before.copy(), np.ones(before.shape[:2], bool)
    now[:6] += 4
    assert flicker(now, before, still) == pytest.approx(2.0)
    still[:6] = False
    assert flicker(now, before, still) == 0.0
    still[:] = False
    assert flicker(now, before, still) is None

# SPDX-License-Identifier: Apache-2.0
"""Scores over time in closed form."""

import numpy as np
import pytest

from structgstream.evaluation.optional_metrics import flicker, warping_error
from structgstream.flow import inside


def noise(seed: int = 0, height: int = 12, width: int = 16) -> np.ndarray:
    return np.random.default_rng(seed).integers(20, 200, (height, width, 3)).astype(np.uint8)


def error_of(now: np.ndarray, before: np.ndarray, *flow: float, seen: np.ndarray | None = None) -> float | None:
    """E_warp by a constant ``flow``, of the pixels ``seen`` or all whose source lies in the picture."""
    backward = np.broadcast_to(np.array(flow, np.float32), (*now.shape[:2], 2)).copy()
    return warping_error(now, before, backward, inside(backward) if seen is None else seen)


def test_a_picture_that_moves_with_its_flow_has_no_error() -> None:
    before = noise()
    now = np.roll(before, (1, 3), (0, 1))
    assert error_of(now, before, -3, -1) == pytest.approx(0.0, abs=1e-10)
    still = error_of(now, before, 0, 0)
    assert still is not None
    assert still > 1e-2


def test_a_change_of_brightness_is_its_square() -> None:
    before = noise()
    assert error_of(before + np.uint8(20), before, 0, 0) == pytest.approx((20 / 255) ** 2, rel=1e-6)


def test_only_seen_pixels_count() -> None:
    before, now = noise(), noise()
    now[3, 4] = 255 - now[3, 4]
    seen = np.ones(now.shape[:2], bool)
    assert error_of(now, before, 0, 0, seen=seen) != 0.0
    seen[3, 4] = False
    assert error_of(now, before, 0, 0, seen=seen) == pytest.approx(0.0, abs=1e-10)
    assert error_of(now, before, 0, 0, seen=np.zeros_like(seen)) is None


def test_flicker_is_the_mean_change_of_still_pixels_in_levels() -> None:
    before = noise()
    now, still = before.copy(), np.ones(before.shape[:2], bool)
    now[:6] += 4
    assert flicker(now, before, still) == pytest.approx(2.0)
    still[:6] = False
    assert flicker(now, before, still) == 0.0
    still[:] = False
    assert flicker(now, before, still) is None

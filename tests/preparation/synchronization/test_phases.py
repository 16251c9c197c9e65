# SPDX-License-Identifier: Apache-2.0
"""The lag of two sounds, from noise whose lag is known."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from structgstream.opus import SAMPLE_RATE
from structgstream.preparation.synchronization.audio import (
    GRID_HERTZ,
    OTHER_SECONDS,
    REACH_SECONDS,
    Window,
    ambiguity_seconds,
    phase_window,
)
from tests.support.properties import examples

LONG = 6.0
REACH = round(REACH_SECONDS * GRID_HERTZ)


def noise(seed: int = 0, seconds: float = LONG) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=round(seconds * SAMPLE_RATE)).astype(np.float32)


def heard(lag: float, *, gain: float = 1.0, snr: float = 3.0) -> tuple[np.ndarray, np.ndarray]:
    """A sound, and the same one later by ``lag`` seconds with noise of its own, at another gain."""
    sound = noise()
    times = np.arange(len(sound)) / SAMPLE_RATE
    late = np.interp(times - lag, times, sound)
    late += np.random.default_rng(9).normal(size=len(times)) / snr
    return sound, (gain * late).astype(np.float32)


@pytest.mark.parametrize("lag", [0.0, 0.0031, -0.5, 1.2345678])
def test_the_lag_is_found_within_a_part_of_a_sample(lag: float) -> None:
    found = phase_window(*heard(lag, gain=0.02), 3.0, lag + 0.002)
    assert found is not None
    assert found.seconds == pytest.approx(lag, abs=3e-6)
    assert found.middle == 3.0


def test_the_expectation_does_not_move_the_answer() -> None:
    answers = [phase_window(*heard(0.25), 3.0, 0.25 + off) for off in (-0.006, -0.001, 0.0, 0.004)]
    assert np.ptp([one.seconds for one in answers if one is not None]) < 2e-6
    assert None not in answers


def test_beyond_its_reach_nothing_stands_out() -> None:
    assert phase_window(*heard(0.25), 3.0, 0.25 + 2 * REACH_SECONDS) is None
    one, _ = heard(0.0)
    assert phase_window(one, noise(5), 3.0, 0.0) is None


def test_silence_and_the_ends_of_a_recording_tell_nothing() -> None:
    one, other = heard(0.0)
    assert phase_window(one, np.zeros_like(other), 3.0, 0.0) is None
    assert phase_window(one, other, 3.0, 0.0) is not None
    assert phase_window(one, other, 0.5, 0.0) is not None  # three quarters of the window are there
    for middle in (-0.3, LONG + 0.3, 50.0):
        assert phase_window(one, other, middle, 0.0) is None


def test_the_curve_has_its_peak_in_the_middle() -> None:
    found = phase_window(*heard(0.25), 3.0, 0.253)
    assert found is not None
    assert len(found.curve) == 2 * REACH + 1
    assert abs(int(found.curve.argmax()) - REACH) <= 1


def curve(*peaks: tuple[float, float]) -> np.ndarray:
    """Narrow peaks of a height at a distance in seconds from the middle."""
    found = np.zeros(2 * REACH + 1)
    for seconds, height in peaks:
        found[REACH + round(seconds * GRID_HERTZ)] = height
    return found


def test_one_peak_is_sure() -> None:
    assert ambiguity_seconds([Window(0.0, 0.0, curve((0.0, 20.0)))]) == 0.0
    near = curve((0.0, 20.0), (0.8 * OTHER_SECONDS, 19.0))
    assert ambiguity_seconds([Window(0.0, 0.0, near)]) == 0.0


def test_an_equal_peak_is_as_likely() -> None:
    two = curve((0.0, 20.0), (0.004, 20.0))
    assert ambiguity_seconds([Window(0.0, 0.0, two)]) == pytest.approx(0.004 / np.sqrt(2), rel=1e-6)
    half = curve((0.0, 20.0), (0.004, 10.0))
    assert ambiguity_seconds([Window(0.0, 0.0, half)]) == pytest.approx(0.004 * np.sqrt(1 / 65), rel=1e-6)


@given(st.lists(st.tuples(st.floats(-0.0075, 0.0075), st.floats(0.0, 20.0)), max_size=5))
@examples(100)
def test_the_uncertainty_is_within_reach_and_windows_that_differ_lower_it(others: list[tuple[float, float]]) -> None:
    one = Window(0.0, 0.0, curve(*others, (0.0, 20.0)))
    alone = ambiguity_seconds([one])
    assert 0.0 <= alone <= REACH_SECONDS
    assert ambiguity_seconds([one, Window(1.0, 0.0, curve((0.0, 20.0)))]) <= alone + 1e-12
    assert ambiguity_seconds([one, one]) == pytest.approx(alone)

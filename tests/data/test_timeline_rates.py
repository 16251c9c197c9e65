# SPDX-License-Identifier: Apache-2.0
"""Which frame serves which instant: properties of the choice, and rates of made time stamps."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from structgstream.data.timeline import STEADY, measured_rate, origin_of, place
from tests.support.properties import examples

TIMES = st.lists(st.floats(-3, 60), min_size=1, max_size=60).map(lambda times: np.array(sorted(times)))


@examples(400)
@given(TIMES)
def test_each_frame_serves_one_instant_and_each_instant_has_its_nearest(positions: np.ndarray) -> None:
    placed = place(positions)
    assert (np.diff(placed.slots) > 0).all()
    assert len(set(placed.frames.tolist())) == len(placed.frames)
    np.testing.assert_allclose(placed.errors, positions[placed.frames] - placed.slots)
    if abs(np.exp(2j * np.pi * positions).mean()) > STEADY:
        return  # such a camera is moved as a whole, see below
    assert (np.abs(placed.errors) <= 0.5).all()
    for slot in range(int(positions[0]) - 1, int(positions[-1]) + 2):
        within = np.abs(positions - slot)
        if slot in placed.slots:
            at = int(np.flatnonzero(placed.slots == slot)[0])
            assert abs(placed.errors[at]) == pytest.approx(within.min())
        else:
            assert within.min() >= 0.5


@examples(200)
@given(st.floats(-0.5, 0.5), st.integers(0, 2**32 - 1), st.integers(2, 80))
def test_a_steady_camera_loses_no_frame_wherever_it_lies(phase: float, seed: int, count: int) -> None:
    jitter = np.random.default_rng(seed).uniform(-0.05, 0.05, count)
    placed = place(np.arange(count) + phase + jitter)
    assert placed.frames.tolist() == list(range(count))
    assert (np.diff(placed.slots) == 1).all()
    assert np.abs(placed.errors).max() < 0.56


@examples(100)
@given(st.lists(st.floats(-0.2, 0.2), min_size=2, max_size=8), st.floats(0, 1))
def test_instants_lie_amid_the_cameras(offsets: list[float], shift: float) -> None:
    """Also when the cameras lie on both sides of half a period."""
    origin = origin_of([np.arange(4.0) + offset + shift for offset in offsets])
    apart = np.array(offsets) + shift - origin
    apart -= np.rint(apart)
    assert np.abs(np.median(apart)) < 1e-6


def test_two_frames_of_one_instant_are_reported_from_a_higher_rate() -> None:
    assert place(np.array([0.0, 1.0, 2.0, 2.25, 3.0])).repeated == (2,)
    assert place(np.arange(0, 6, 0.5)).repeated == ()


def test_the_rate_is_the_median_or_of_different_ones_the_lowest() -> None:
    thirty, sixty = np.arange(30) / 30, np.arange(60) / 60
    assert measured_rate([thirty, thirty * (1 + 1e-4), thirty]) == 30.0
    assert measured_rate([thirty, sixty, sixty]) == 30.0
    assert measured_rate([np.delete(thirty, [3, 4, 17])]) == 30.0
    assert measured_rate([np.arange(30) * 1001 / 30000]) == pytest.approx(30000 / 1001)
    assert measured_rate([np.zeros(1)]) is None

# SPDX-License-Identifier: Apache-2.0
"""Times of pictures from stamps that jump, repeat, go back, wrap, drift and come late: synthetic time."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from structgstream.data.live.camera import ClockMapper, ClockResets, PictureTime
from structgstream.data.live.rig_file import TimeBase
from structgstream.data.live.status import Fault
from tests.support.properties import examples

UNIX = 1_700_000_000.0
PERIOD = 1 / 30
WRAP = 2**33 / 90_000


def placed(mapper: ClockMapper, stamps, arrivals, **options) -> list[Any]:
    return [mapper.map(stamp, arrived=at, **options).seconds for stamp, at in zip(stamps, arrivals, strict=True)]


def seconds_of(found: list[PictureTime]) -> np.ndarray:
    return np.array([item.seconds for item in found], np.float64)


def test_arrival_keeps_the_spacing_of_the_stamps_in_spite_of_jitter() -> None:
    """The least delay wins: after the first pictures, times lie where the quickest network would have put them."""
    stamps = np.arange(300) * PERIOD
    jitter = np.random.default_rng(0).uniform(0, 0.05, 300)
    times = placed(ClockMapper(TimeBase.ARRIVAL), stamps, UNIX + stamps + 0.02 + np.maximum.accumulate(jitter * 0))
    assert times == pytest.approx(list(UNIX + stamps + 0.02), abs=1e-6)
    late = placed(ClockMapper(TimeBase.ARRIVAL), stamps, np.maximum.accumulate(UNIX + stamps + 0.02 + jitter))
    errors = np.array(late[60:]) - (UNIX + stamps + 0.02)[60:]
    assert errors.min() > -1e-6
    assert errors.max() < 0.005  # the least of 60 uniform values of 50 ms


def test_pictures_that_were_held_back_are_no_jump() -> None:
    """A server's buffer, or a stalled network: many pictures at once, which then are on time again."""
    stamps = np.arange(300) * PERIOD
    arrivals = np.maximum(UNIX + stamps, UNIX + np.where((stamps > 3) & (stamps < 7), 7, 0))
    arrivals = np.maximum.accumulate(arrivals + 1e-4 * np.arange(300))
    for base in (TimeBase.ARRIVAL, TimeBase.STREAM):
        mapper = ClockMapper(base)
        found = [mapper.map(stamp, arrived=at) for stamp, at in zip(stamps, arrivals, strict=True)]
        assert [item.fault for item in found] == [None] * 300
        assert np.allclose(np.diff(seconds_of(found)), PERIOD, atol=2e-4)


def test_a_clock_that_runs_fast_is_followed_by_arrival() -> None:
    stamps = np.arange(0, 3600, 0.5)
    arrivals = UNIX + stamps / 1.0002  # 0.7 s an hour
    times = placed(ClockMapper(TimeBase.ARRIVAL), stamps, arrivals)
    assert np.abs(np.array(times) - arrivals).max() < 0.008


def test_stream_takes_stamps_and_offsets() -> None:
    assert placed(ClockMapper(TimeBase.STREAM, offset_seconds=-0.25), [5.0, 5.5], [UNIX, UNIX + 0.5]) == [4.75, 5.25]


@pytest.mark.parametrize("jump", [100.0, -100.0, 1e6, -1.5])
@pytest.mark.parametrize("base", TimeBase)
def test_after_a_jump_pictures_go_on_as_late_as_before(base: TimeBase, jump: float) -> None:
    mapper = ClockMapper(base)
    before, after = np.arange(90) * PERIOD, np.arange(90, 180) * PERIOD
    start = placed(mapper, before, UNIX + before + 0.03)
    found = mapper.map(after[0] + jump, arrived=UNIX + after[0] + 0.034)
    assert found.fault is Fault.JUMP
    assert found.reset_seconds == pytest.approx(jump, abs=0.005)
    rest = placed(mapper, after[1:] + jump, UNIX + after[1:] + 0.03)
    steps = np.diff(np.array([*start, found.seconds, *rest], np.float64))
    assert np.abs(steps - PERIOD).max() < 0.005


def test_cameras_whose_common_clock_is_set_stay_in_step_exactly() -> None:
    """Their arrivals jitter by milliseconds, which would part them by as much."""
    resets = ClockResets()
    a, b = (ClockMapper(TimeBase.STREAM, resets=resets) for _ in range(2))
    for mapper in (a, b):
        placed(mapper, np.arange(30) * PERIOD, UNIX + np.arange(30) * PERIOD)
    first = a.map(500.0, arrived=UNIX + 1.0 + 0.012)
    second = b.map(500.0, arrived=UNIX + 1.0 + 0.003)
    assert first.seconds == second.seconds
    third = ClockMapper(TimeBase.STREAM, resets=resets)
    placed(third, [0.0, 0.5], [UNIX, UNIX + 0.5])
    other = third.map(900.0, arrived=UNIX + 1.0)
    assert other.seconds == pytest.approx(1.0)


@pytest.mark.parametrize("base", TimeBase)
@pytest.mark.parametrize("stamp", [0.0, 3.0, 5000.0])
def test_stamps_of_a_new_connection_may_begin_anew(base: TimeBase, stamp: float) -> None:
    mapper = ClockMapper(base)
    placed(mapper, np.arange(91) * PERIOD, UNIX + np.arange(91) * PERIOD)
    mapper.reconnect()
    found = [mapper.map(stamp + t, arrived=UNIX + 10 + t) for t in np.arange(30) * PERIOD]
    assert {item.fault for item in found} == {None}
    if base is TimeBase.ARRIVAL or stamp != 3.0:
        assert np.allclose(np.diff(seconds_of(found)), PERIOD, atol=1e-5)
    if base is TimeBase.ARRIVAL:
        assert found[0].seconds == pytest.approx(UNIX + 10, abs=1e-3)


def test_duplicates_and_stamps_that_go_back_are_left_out() -> None:
    mapper = ClockMapper(TimeBase.STREAM)
    stamps = [0.0, 0.1, 0.1, 0.3, 0.2, 0.4]
    found = [mapper.map(stamp, arrived=UNIX + 0.1 * n) for n, stamp in enumerate(stamps)]
    assert [item.fault for item in found] == [None, None, Fault.DUPLICATE, None, Fault.REORDERED, None]
    assert [item.seconds for item in found] == [0.0, 0.1, None, 0.3, None, 0.4]


@pytest.mark.parametrize("base", TimeBase)
def test_stamps_of_33_bits_wrap(base: TimeBase) -> None:
    mapper = ClockMapper(base)
    true = WRAP - 1 + np.arange(60) * PERIOD
    found = [mapper.map(t % WRAP, arrived=UNIX + t, wrap_seconds=WRAP) for t in true]
    assert {item.fault for item in found} == {None}
    assert np.allclose(np.diff(seconds_of(found)), PERIOD)


def test_unix_stamps_are_found_again_from_33_bits() -> None:
    mapper = ClockMapper(TimeBase.UNIX)
    true = UNIX + np.arange(10) * PERIOD
    times = placed(mapper, true % WRAP, true + 0.2, wrap_seconds=WRAP)
    assert times == pytest.approx(list(true), abs=1e-5)
    assert mapper.shift == pytest.approx(UNIX - UNIX % WRAP, abs=1e-5)


@given(
    st.sampled_from(list(TimeBase)),
    st.lists(st.tuples(st.floats(-200, 200), st.floats(0, 3)), min_size=1, max_size=60),
)
@examples(150)
def test_times_rise_whatever_comes(base: TimeBase, steps: list[tuple[float, float]]) -> None:
    mapper, stamp, arrived, last = ClockMapper(base), 0.0, UNIX, -np.inf
    for by, wait in steps:
        stamp, arrived = stamp + by, arrived + wait
        seconds = mapper.map(stamp, arrived=arrived, wrap_seconds=WRAP).seconds
        if seconds is not None:
            assert seconds > last
            last = seconds

# SPDX-License-Identifier: Apache-2.0
"""Where groups begin."""

from itertools import islice, pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from structgstream.codec.packets import PacketKind
from structgstream.session.periods import MIN_FRAMES, KeyFrames


def keys_of(keys: KeyFrames, times: list[float], *, first: int = 0) -> list[int]:
    found = []
    for index, time in enumerate(times, first):
        if keys.kind(index, time) is PacketKind.KEY:
            keys.begin(index, time)
            found.append(index)
    return found


@given(st.integers(1, 70), st.sampled_from((15.0, 24_000 / 1001, 25.0, 30.0, 120.0)))
def test_where_no_frame_is_left_out_groups_have_as_many_frames(interval: int, fps: float) -> None:
    times = [index / fps for index in range(200)]
    assert keys_of(KeyFrames(interval, fps), times) == [*range(0, 200, interval)]


def test_where_frames_are_left_out_groups_last_as_long() -> None:
    times = [0.2 * index for index in range(40)]
    assert keys_of(KeyFrames(60, 30.0), times) == [0, 10, 20, 30]


def test_a_group_has_a_few_frames_however_far_apart_these_are() -> None:
    times = [3.0 * index for index in range(20)]
    found = keys_of(KeyFrames(30, 30.0), times)
    assert {after - before for before, after in pairwise(found)} == {MIN_FRAMES}
    assert keys_of(KeyFrames(2, 30.0), times) == [*range(0, 20, 2)]


@pytest.mark.parametrize("stopped", [1, 4, 7, 12, 15])
def test_a_resumed_stream_has_the_same_groups(stopped: int) -> None:
    times = [0.0, 0.03, 0.9, 1.1, 1.2, 1.4, 3.0, 3.1, 3.2, 3.3, 3.4, 9.0, 9.1, 9.2, 12.0, 12.1, 12.2, 12.3]
    whole = keys_of(KeyFrames(30, 30.0), times)
    before = [index for index in whole if index < stopped]
    resumed = KeyFrames(30, 30.0)
    for index in before:
        resumed.begin(index, times[index])
    assert before + keys_of(resumed, times[stopped:], first=stopped) == whole


@pytest.mark.parametrize(("apart", "group"), [(1 / 30, 30), (0.1, 10), (9.0, MIN_FRAMES)])
def test_frames_before_a_key_frame_are_near_it(apart: float, group: int) -> None:
    keys = KeyFrames(30, 30.0)
    assert not keys.near(0, 0.0, within=3)
    keys.begin(0, 0.0)
    assert [i for i in range(group) if keys.near(i, i * apart, within=3)] == [group - 3, group - 2, group - 1]


@pytest.mark.parametrize(("apart", "group"), [(1 / 30, 30), (0.1, 10), (9.0, MIN_FRAMES)])
@pytest.mark.parametrize("since", [0, 1, 4])
def test_key_frames_are_foreseen(apart: float, group: int, since: int) -> None:
    keys = KeyFrames(30, 30.0)
    keys.begin(100, 7.0)
    coming = keys.ahead(100 + since, 7.0 + since * apart, spacing=apart)
    assert [*islice(coming, 3)] == [group - since, 2 * group - since, 3 * group - since]


def test_a_group_that_has_lasted_too_long_ends_with_the_next_frame() -> None:
    keys = KeyFrames(30, 30.0)
    keys.begin(0, 0.0)
    assert [*islice(keys.ahead(7, 60.0, spacing=0.1), 2)] == [1, 11]
    assert (keys.interval, keys.least, KeyFrames(3, 30.0).least) == (30, MIN_FRAMES, 3)

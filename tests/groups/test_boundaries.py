# SPDX-License-Identifier: Apache-2.0
"""Where groups begin."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from structgstream.errors import ConfigError
from structgstream.groups.track_file import check_length, equal_groups, quiet_groups


@given(st.integers(1, 200), st.integers(1, 40))
def test_equal_groups_have_every_frame_once(frames: int, length: int) -> None:
    groups = equal_groups(frames, length)
    assert [frame for first, end in groups for frame in range(first, end)] == [*range(frames)]
    assert all(end - first == length for first, end in groups[:-1])
    assert groups[-1][1] - groups[-1][0] in range(2, length + 2) or length == 1 or frames == 1


def test_a_last_frame_by_itself_goes_to_the_group_before() -> None:
    assert equal_groups(61, 30) == [(0, 30), (30, 61)]
    assert equal_groups(62, 30) == [(0, 30), (30, 60), (60, 62)]
    assert equal_groups(1, 30) == [(0, 1)]
    assert equal_groups(3, 1) == [(0, 1), (1, 2), (2, 3)], "as was asked for"
    assert quiet_groups(61, 30, {30: 0.1, 60: 0.0}) == [(0, 30), (30, 61)]


@given(st.integers(1, 20), st.integers(1, 4), st.data())
def test_quiet_groups_have_every_frame_once_and_begin_at_candidates(
    units: int, every: int, data: st.DataObject
) -> None:
    frames = units * every
    changed = {at: data.draw(st.floats(0, 1)) for at in range(every, frames, every)}
    length = every * data.draw(st.integers(1, 4))
    groups = quiet_groups(frames, length, changed)
    assert [frame for first, end in groups for frame in range(first, end)] == [*range(frames)]
    assert {first for first, _ in groups[1:]} <= changed.keys()
    assert all(end - first <= length + length // 2 for first, end in groups)


def test_borders_lie_where_little_moves() -> None:
    changed = dict.fromkeys(range(10, 100, 10), 0.3) | {30: 0.01, 60: 0.02}
    assert quiet_groups(100, 30, changed) == [(0, 30), (30, 60), (60, 100)]
    shifted = dict.fromkeys(range(10, 100, 10), 0.3) | {20: 0.01, 60: 0.02}
    assert quiet_groups(100, 30, shifted) == [(0, 20), (20, 60), (60, 100)]


def test_a_length_off_the_key_packets_is_refused_with_the_nearest_that_is_on_them() -> None:
    check_length(60, key_interval=30)
    with pytest.raises(ConfigError, match="one every 30 frames .* take 60"):
        check_length(50, key_interval=30)
    with pytest.raises(ConfigError, match="Groups of 0 frames"):
        check_length(0, key_interval=30)

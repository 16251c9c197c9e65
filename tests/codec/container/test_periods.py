# SPDX-License-Identifier: Apache-2.0
"""Which period a frame belongs to."""

from hypothesis import given
from hypothesis import strategies as st

from structgstream.codec.container.index import Period, period_at


def periods(firsts: list[int]) -> list[Period]:
    return [Period(number, first, 12 + 100 * number, 50) for number, first in enumerate(firsts)]


def test_a_period_begins_with_its_first_frame_and_ends_before_the_next() -> None:
    found = periods([0, 4, 9])
    assert [period_at(found, frame) for frame in (0, 3, 4, 8, 9, 10**9)] == [0, 0, 1, 1, 2, 2]


@given(st.sets(st.integers(1, 40), max_size=8), st.integers(0, 50))
def test_it_is_the_last_one_that_has_begun(later: set[int], frame: int) -> None:
    firsts = [0, *sorted(later)]
    assert period_at(periods(firsts), frame) == sum(first <= frame for first in firsts) - 1


def test_frames_before_the_first_that_is_known_belong_to_it() -> None:
    assert period_at(periods([30, 60]), 7) == 0

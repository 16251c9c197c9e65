# SPDX-License-Identifier: Apache-2.0
"""The head of a packet's payload is the documented one."""

import math

from hypothesis import given
from hypothesis import strategies as st

from structgstream.codec.container.records import FRAME


@given(st.integers(0, 2**32 - 1), st.floats(allow_nan=False))
def test_four_bytes_of_a_number_and_eight_of_a_time_the_lowest_first(frame: int, seconds: float) -> None:
    data = FRAME.pack(frame, seconds)
    assert len(data) == FRAME.size == 12
    assert data[:4] == frame.to_bytes(4, "little")
    assert FRAME.unpack(data) == (frame, seconds)


def test_a_number_by_hand() -> None:
    assert FRAME.pack(258, 1.0).hex() == "02010000" + "000000000000f03f"
    assert math.isnan(FRAME.unpack(bytes.fromhex("00000000" + "000000000000f87f"))[1])

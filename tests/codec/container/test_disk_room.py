# SPDX-License-Identifier: Apache-2.0
"""A disk that is nearly full."""

import shutil
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from structgstream.codec.container.byte_source import MARGIN_PACKETS, check_room, free_bytes
from structgstream.errors import StorageError


@given(st.integers(0, 10**6), st.integers(1, 10**6), st.integers(0, 10**6))
def test_the_next_packets_and_the_end_must_fit(free: int, largest: int, closing: int) -> None:
    if free >= MARGIN_PACKETS * largest + closing:
        check_room(free, largest=largest, closing=closing, where="it", frames=3)
    else:
        with pytest.raises(StorageError, match="nearly full"):
            check_room(free, largest=largest, closing=closing, where="it", frames=3)


def test_what_is_said() -> None:
    told = "The disk of ball.sgs is nearly full: 99 bytes are left, and 310 are kept .* after 7 frames, all of which"
    with pytest.raises(StorageError, match=told):
        check_room(99, largest=100, closing=10, where="ball.sgs", frames=7)


def test_an_unknown_disk_is_not_full() -> None:
    check_room(None, largest=10**12, closing=0, where="it", frames=0)


def test_the_room_is_that_of_the_disk(tmp_path: Path) -> None:
    free = free_bytes(tmp_path)
    assert free is not None
    assert abs(free - shutil.disk_usage(tmp_path).free) < 2**30
    assert free_bytes(tmp_path / "missing") is None

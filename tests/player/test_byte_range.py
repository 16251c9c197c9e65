# SPDX-License-Identifier: Apache-2.0
"""The Range header: what RFC 9110 says of each kind."""

import pytest

from structgstream.player.byte_range import UnsatisfiableRange, requested_range

SIZE = 1000


@pytest.mark.parametrize(
    ("header", "expected"),
    [
        ("bytes=0-0", range(1)),
        ("bytes=0-499", range(500)),
        ("bytes=500-999", range(500, 1000)),
        ("bytes=500-", range(500, 1000)),
        ("bytes=999-5000", range(999, 1000)),
        ("bytes=-1", range(999, 1000)),
        ("bytes=-5000", range(1000)),
        ("BYTES= 3-4 ", range(3, 5)),
    ],
)
def test_ranges(header: str, expected: range) -> None:
    assert requested_range(header, SIZE) == expected


@pytest.mark.parametrize("header", ["bytes=1000-", "bytes=1000-1001", "bytes=-0", "bytes=999999999999999999-"])
def test_nothing_of_it_is_there(header: str) -> None:
    with pytest.raises(UnsatisfiableRange):
        requested_range(header, SIZE)


@pytest.mark.parametrize("header", ["bytes=0-", "bytes=-5", "bytes=0-0"])
def test_an_empty_file_has_no_range(header: str) -> None:
    with pytest.raises(UnsatisfiableRange):
        requested_range(header, 0)


@pytest.mark.parametrize(
    "header",
    [
        None,
        "",
        "bytes=",
        "bytes=-",
        "bytes=5",
        "bytes=7-3",
        "bytes=0-1,4-5",
        "items=0-5",
        "bytes=a-b",
        "bytes=٣-٤",
        "bytes=--5",
        "bytes=" + "9" * 400 + "-",
        "bytes=0-1\nbytes=2-3",
    ],
)
def test_what_counts_as_no_range(header: str | None) -> None:
    assert requested_range(header, SIZE) is None

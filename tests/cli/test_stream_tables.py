# SPDX-License-Identifier: Apache-2.0
"""Tables of numbers that are given here. How they look for real streams is in ``test_inspect.py``."""

from dataclasses import replace
from typing import Any

import pytest
from rich.table import Table

from structgstream.cli.inspect import bit_rate_text, facts_table, header_table, packet_table, period_table
from structgstream.evaluation.byte_count import Row
from tests.support.consoles import console, text

HEADER: dict[str, Any] = {
    "metadata": {"capture": "hall [1]"},
    "codec": "compact",
    "fps": 25.0,
    "cameras": {
        "a": {"held_out": True, "width": 64, "height": 48},
        "b": {"held_out": False, "width": 32, "height": 48},
    },
    "total_bytes": 5000,
    "header_bytes": 1000,
    "fields": {"free": {"bytes": 0, "shape": [0, 14]}, "offset_scales": {"bytes": 240, "shape": [20, 3]}},
    "dynamic": ["free"],
    "damage": [],
    "complete": True,
    "cut_reason": None,
    "period": 0,
    "periods": [{}],
}


def rows(count: int, *, bytes: int = 100) -> list[Row]:
    sizes = {"free": bytes - 10}
    return [Row(i, "delta" if i else "key", i / 25, 1000 + i * bytes, bytes, sizes, first=i == 0) for i in range(count)]


def shown(table: Table) -> list[str]:
    to = console(width=100)
    to.print(table)
    return [" ".join(line.split()) for line in text(to).splitlines() if line.strip()]


def packet(changes: dict[str, int], counts: dict[str, int]) -> dict[str, Any]:
    return {"changes": changes, "counts": counts}


def test_what_a_stream_is_in_a_line_for_each_fact() -> None:
    packets = [
        packet({"grown": 5, "removed": 2}, {"displaced": 3}),
        packet({"spawned": 4}, {"displaced": 4, "scene cuts": 0}),
    ]
    lines = shown(facts_table(HEADER, rows(2), packets=packets))
    for line in (
        "capture hall [1]",
        "frames 2 at 25 a second, 0.08 s",
        "cameras 2 of 32x48, 64x48; held out: a",
        "size 5.0 kB, header 1.0 kB",
        "rate 0.02 Mbit/s without the header",
        "came, went anchors (+5 -2), free Gaussians (+4 -0), says the log",
        "acts displaced 7, scene cuts 0",
        "state complete: its run ended or was stopped in order",
    ):
        assert line in lines


@pytest.mark.parametrize(("damage", "state"), [([], "not finished"), ([{"offset": 1}], "damaged")])
def test_a_stream_that_is_not_whole_says_why(damage: list[dict[str, int]], state: str) -> None:
    header = HEADER | {"damage": damage, "complete": False, "cut_reason": "it ends in frame 3"}
    lines = shown(facts_table(header, [], packets=[]))
    assert f"state {state}: it ends in frame 3" in lines
    assert not [line for line in lines if line.startswith(("rate ", "came, ", "acts "))]


def test_the_rate_by_hand() -> None:
    """50 kB a frame, 25 times a second, 8 bits each; with a frame in 2 s instead, three in 4.04 s."""
    assert bit_rate_text(rows(3, bytes=50_000), 25.0) == "10.00 Mbit/s without the header"
    sparse = [replace(row, pts_seconds=2.0 * row.index) for row in rows(3, bytes=50_000)]
    assert bit_rate_text(sparse, 25.0) == "0.30 Mbit/s without the header"
    assert "frames 3, at most 25 a second, 4.04 s" in shown(facts_table(HEADER, sparse, packets=[]))


def test_the_header_by_field_the_largest_first() -> None:
    lines = shown(header_table(HEADER))
    assert lines[-3:] == ["offset scales 20 x 3 240 24.0% 32.00", "free 0 x 14 0 0.0% -", "the rest 760 76.0%"]


def test_large_packets_are_reported_in_kilobytes() -> None:
    assert "packets, bytes" in shown(packet_table(rows(2), every=True))[0]
    large = shown(packet_table(rows(2, bytes=250_000), every=True))
    assert "packets, kB" in large[0]
    assert any(line.startswith("1 delta 250.0") for line in large)


def test_periods_have_a_row_each_where_there_are_several() -> None:
    fields = {"anchor_positions": {"bytes": 9, "shape": [4321, 3]}}
    one = {"period": 0, "first_frame": 0, "frames": 8, "seconds": 0.32, "header_bytes": 1200, "packet_bytes": 500}
    first = one | {"begins": None, "fields": fields}
    later = one | {"period": 1, "first_frame": 8, "begins": "residual 1.71 times the first frame's", "fields": {}}
    assert period_table([first]) is None
    table = period_table([first, later])
    assert table is not None
    lines = shown(table)
    assert "0 0 8 0.32 4,321 1.2 kB 500 B -" in lines
    assert "1 8 8 0.32 - 1.2 kB 500 B residual 1.71 times the first frame's" in lines
    header = HEADER | {"periods": [first, later]}
    assert "size 5.0 kB, 2 headers 1.0 kB" in shown(facts_table(header, rows(2), packets=[]))

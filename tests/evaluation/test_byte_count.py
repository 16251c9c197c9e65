# SPDX-License-Identifier: Apache-2.0
"""Bytes by packet, field and kind: they add up to the file; and their picture."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from structgstream.codec.container.records import PREFIX
from structgstream.codec.reader import StreamReader
from structgstream.codec.sinks import MemorySink
from structgstream.evaluation.byte_count import (
    FIRST,
    REST,
    Parts,
    Row,
    field_colors,
    groups_of,
    occurring_fields,
    packet_rows,
    parts_of,
    with_rest,
    write_byte_plot,
)
from structgstream.figure import COLORS, OTHER
from tests.support.drawn import coloured, pixels_of
from tests.support.rigs import random_scene
from tests.support.streams import compact_header, header_for, moved, small_scene, write_stream


def reader_of(*, frames: int, compact: bool) -> StreamReader:
    scenes = [moved(random_scene(12, seed=1), i) for i in range(frames)]
    sink = MemorySink()
    write_stream(sink, scenes, header=compact_header(scenes[0]) if compact else header_for(scenes[0]))
    return StreamReader(sink.data)


@pytest.mark.parametrize("compact", [False, True])
def test_all_bytes_of_a_stream_are_counted_once(compact: bool) -> None:
    reader = reader_of(frames=7, compact=compact)
    rows = packet_rows(reader)
    assert [(row.index, row.kind) for row in rows] == [(i, "delta" if i % 3 else "key") for i in range(7)]
    assert all(sum(row.sizes.values()) == row.bytes and row.sizes[REST] > 0 for row in rows)
    assert [row.offset for row in rows[1:]] == [row.offset + row.bytes for row in rows[:-1]]
    assert sum(parts_of(reader, rows)["header"].values()) == reader.header_bytes == rows[0].offset > PREFIX.size
    assert rows[0].pts_seconds == 0.0
    assert rows[3].pts_seconds == pytest.approx(0.1)


def test_a_first_packet_without_news_is_no_part() -> None:
    scenes = [small_scene(4000)] * 4  # Nothing moves, so the first packet of a compact stream tells nothing.
    sink = MemorySink()
    write_stream(sink, scenes, header=compact_header(scenes[0]))
    reader = StreamReader(sink.data)
    still = parts_of(reader, packet_rows(reader))
    assert [*still] == ["header", "key packets", "delta packets"]
    raw = reader_of(frames=7, compact=False)
    assert [*parts_of(raw, packet_rows(raw))] == ["header", FIRST, "key packets", "delta packets"]
    alone = reader_of(frames=1, compact=False)
    assert [*parts_of(alone, packet_rows(alone))] == ["header", FIRST]
    assert [*parts_of(alone, [])] == ["header"]


def test_means_by_kind_leave_the_first_packet_apart() -> None:
    sizes = [("key", 1), ("delta", 10), ("delta", 20), ("key", 300), ("delta", 60)]
    rows = [
        Row(i, kind, i / 30, 0, size + 24, {"free": size, REST: 24}, first=i == 0)
        for i, (kind, size) in enumerate(sizes)
    ]
    rows[2] = replace(rows[2], bytes=64, sizes={"free": 20, "appearance": 20, REST: 24})
    groups = groups_of(rows)
    assert {name: sum(sizes.values()) for name, sizes in groups.items()} == {
        FIRST: 25,
        "key packets": 324,
        "delta packets": pytest.approx((34 + 64 + 84) / 3),
    }
    assert groups["delta packets"] == {"free": 30, "appearance": pytest.approx(20 / 3), REST: 24}
    assert [*groups["delta packets"]] == ["free", "appearance", REST]
    assert [*groups_of(rows[:1])] == [FIRST]


def test_the_largest_field_comes_first_and_the_rest_last() -> None:
    assert with_rest({"free": 5, "appearance": 7}, 100) == {"free": 5, "appearance": 7, REST: 88}
    assert occurring_fields([{"a": 5, REST: 50}, {"b": 4, "c": 9}, {"b": 4}]) == ["c", "b", "a", REST]


HEADER = {"anchor_features": 6e5, "anchor_positions": 3e5, REST: 4e3}


def packets(count: int, *, key_times: float = 2.0) -> list[Row]:
    """Mostly positions, then free Gaussians; every fifth a key packet."""
    rows = []
    for i in range(count):
        size = round(10_000 * (key_times if i % 5 == 0 else 1.0))
        sizes = {"anchor_positions": size, "free": size // 2, "free_births": 20, REST: 24}
        rows.append(Row(i, "delta" if i % 5 else "key", i / 30, 0, sum(sizes.values()), sizes, first=i == 0))
    return rows


def parts(rows: list[Row]) -> Parts:
    return {"header": HEADER, **groups_of(rows)}


def test_colours_go_to_the_largest_fields_of_the_delta_packets_first() -> None:
    assert field_colors(parts(packets(6))) == {
        "anchor_positions": COLORS[0],
        "free": COLORS[1],
        "anchor_features": COLORS[2],
        REST: OTHER,
    }
    many = {"header": {f"field {i}": 1.0 for i in range(20)}}
    assert len(field_colors(many)) == len(COLORS) + 1


def test_every_field_is_seen_in_both_panels(tmp_path: Path) -> None:
    rows = packets(12)
    write_byte_plot(tmp_path / "new" / "bytes.png", rows, parts(rows), title="ball")
    picture = pixels_of(tmp_path / "new" / "bytes.png")
    bars, shares = np.split(picture[:, : int(0.8 * picture.shape[1])], [int(0.7 * picture.shape[0])])
    for panel in (bars, shares):
        first, second = coloured(panel, COLORS[0]), coloured(panel, COLORS[1])
        assert first > second > 1000
    assert coloured(bars, COLORS[0]) == pytest.approx(2 * coloured(bars, COLORS[1]), rel=0.05)
    assert coloured(shares, COLORS[2]) > 1000 > coloured(bars, COLORS[2])


def bars_of(path: Path, rows: list[Row]) -> float:
    """Share of the upper panel that the first field covers."""
    write_byte_plot(path, rows, parts(rows), title="")
    picture = pixels_of(path)
    panel = picture[: int(0.7 * picture.shape[0]), : int(0.8 * picture.shape[1])]
    return coloured(panel, COLORS[0]) / panel[..., 0].size


def test_a_towering_key_packet_does_not_hide_the_others(tmp_path: Path) -> None:
    cut, whole = bars_of(tmp_path / "a.png", packets(11, key_times=50)), bars_of(tmp_path / "b.png", packets(11))
    assert cut > 0.8 * whole > 0.1
    keys = [replace(row, index=i) for i, row in enumerate(packets(50, key_times=3)[::5])]
    assert bars_of(tmp_path / "keys.png", keys) > 0.3


def test_a_long_stream_and_a_packet_alone(tmp_path: Path) -> None:
    assert bars_of(tmp_path / "long.png", packets(400)) > 0.1
    assert bars_of(tmp_path / "one.png", packets(1)) > 0.1

# SPDX-License-Identifier: Apache-2.0
"""Bytes by packet, field and kind: they add up to the file."""

from dataclasses import replace

import pytest

from structgstream.codec.container.records import PREFIX
from structgstream.codec.reader import StreamReader
from structgstream.codec.sinks import MemorySink
from structgstream.evaluation.byte_count import (
    FIRST,
    REST,
    Row,
    groups_of,
    occurring_fields,
    packet_rows,
    parts_of,
    with_rest,
)
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

# SPDX-License-Identifier: Apache-2.0
"""Streams of several periods: what is in them, and what of it a damaged one still shows. The headers of periods, read
when they are asked for: damaged ones, and those of another stream, are refused."""

import struct
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest

from structgstream.cameras import Similarity
from structgstream.codec.container.records import (
    INDEX_ENTRY,
    MINOR_WITH_PERIODS,
    PREFIX,
    Period,
    Record,
    RecordType,
    pack_index,
    packed,
    prefix,
    read_index,
    scan_records,
)
from structgstream.codec.contents import PeriodTable, differences
from structgstream.codec.packets import StreamHeader, pack_header
from structgstream.codec.reader import StreamReader, open_stream
from structgstream.codec.sinks import FileSink, MemorySink
from structgstream.errors import StreamError
from structgstream.scene.scene import Scene
from tests.support.period_streams import (
    FIRSTS,
    FRAMES,
    KEYS,
    LENGTHS,
    period_header,
    period_of,
    period_packets,
    period_stream,
    write_packets,
)
from tests.support.properties import thinned
from tests.support.rigs import arc_rig
from tests.support.streams import flipped, same, small_stream

CODECS = ("raw", "compact")


def offsets(kind: RecordType) -> list[tuple[int, int]]:
    """Where the records of a type begin and end."""
    return [(record.offset, record.end) for record in scan_records(period_stream()[0]) if record.type == kind]


def group(frame: int) -> range:
    """The frames that need the packet of ``frame`` or are it."""
    after = [key for key in (*KEYS, FRAMES) if key > frame]
    return range(frame, min(after))


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize("by_index", [False, True])
def test_every_frame_is_decoded_with_the_header_of_its_period(codec: str, by_index: bool) -> None:
    data, seen = period_stream(codec=codec)
    reader = StreamReader(data, by_index=by_index)
    assert (len(reader), reader.complete, reader.runs) == (FRAMES, True, [range(FRAMES)])
    assert [(one.number, one.first_frame) for one in reader.periods] == [*enumerate(FIRSTS)]
    for index in (*range(FRAMES), *reversed(range(FRAMES)), 3, 4, 3, 11, 0, 10):
        assert same(reader.scene(index), seen[index]), index
        assert len(reader.header_of(index).static["base_scales"]) == 3 + period_of(index)


def test_the_bytes_are_a_prefix_init_records_packets_and_an_index_of_all() -> None:
    data, _ = period_stream()
    assert PREFIX.unpack(data[: PREFIX.size])[1:] == (2, MINOR_WITH_PERIODS)
    *records, index = scan_records(data)
    frames = [record for record in records if record.type != RecordType.INIT]
    assert [record.period for record in frames] == [period_of(frame) for frame in range(FRAMES)]
    begins = [record.period for record in records if record.type == RecordType.INIT]
    assert begins == [0, 1, 2]
    entries = [*INDEX_ENTRY.iter_unpack(index.payload)]
    assert entries == [
        (sum(one.offset < record.offset for one in frames), record.type, record.offset) for record in records[1:]
    ]
    reader = StreamReader(data)
    assert reader.header_bytes == PREFIX.size + sum(one.bytes for one in reader.periods)
    assert reader.header_bytes + sum(info.bytes for info in reader.packets) == index.offset


def test_a_stream_of_one_period_is_what_it_was() -> None:
    """The number of its period is 0 in all records, and so is what it has in its prefix."""
    data = small_stream()
    assert data.startswith(prefix())
    assert {record.period for record in scan_records(data)} == {0}


def test_any_bit_of_a_packet_costs_its_group_and_never_shows_another_periods_scene() -> None:
    data, seen = period_stream()
    packets = [record for record in scan_records(data) if record.type in (RecordType.KEY, RecordType.DELTA)]
    for frame, record in enumerate(packets):
        for bit in (
            *thinned(range(8 * record.offset, 8 * (record.offset + 20), 20)),
            *thinned(range(8 * record.offset, 8 * record.end, 3989)),
        ):
            check(data, seen, bit, lost=set(group(frame)))


def test_any_bit_of_an_init_record_costs_its_period() -> None:
    data, seen = period_stream()
    for period, (start, end) in enumerate(offsets(RecordType.INIT)):
        if not period:
            continue
        lost = {*range(FIRSTS[period], FIRSTS[period] + LENGTHS[period])}
        for bit in (*thinned(range(8 * start, 8 * (start + 12), 3)), *thinned(range(8 * start, 8 * end, 2999))):
            check(data, seen, bit, lost=lost)


def check(data: bytes, seen: list[Scene], bit: int, *, lost: set[int]) -> None:
    """With one bit flipped exactly ``lost`` cannot be shown, and every other frame is what it was."""
    reader = StreamReader(flipped(data, bit))
    shown = {index for run in reader.runs for index in run}
    assert shown == {*range(FRAMES)} - lost, bit
    assert len(reader.damage) == 1
    assert {*reader.damage[0].frames} == lost
    for index in {min(lost) - 1, max(lost) + 1} & shown:
        assert same(reader.scene(index), seen[index]), (bit, index)


def test_an_init_record_and_its_key_packet_may_both_be_damaged() -> None:
    """What is before a whole init record then is unknown, until a packet says which frame it is."""
    data, seen = period_stream()
    frames = [record for record in scan_records(data) if record.type != RecordType.INIT]
    # The packet before period 1's init record, and the one after it.
    reader = StreamReader(flipped(data, *(8 * (record.offset + 30) + 2 for record in frames[3:5])))
    assert reader.runs == [range(3), range(6, FRAMES)]
    assert [one.number for one in reader.periods] == [0, 1, 2]
    assert all(same(reader.scene(index), seen[index]) for index in (2, 6, 7, 9))


def test_two_periods_whose_init_records_are_damaged_are_lost_and_no_more() -> None:
    data, seen = period_stream()
    reader = StreamReader(flipped(data, *(8 * (end - 3) for _, end in offsets(RecordType.INIT)[1:])))
    assert reader.runs == [range(4)]
    assert len(reader.packets) == 4
    assert same(reader.scene(3), seen[3])
    with pytest.raises(StreamError, match="Frame 9 of The stream is lost"):
        reader.scene(9)


def test_a_file_cut_anywhere_shows_what_is_whole_and_goes_on_to_the_same_bytes(tmp_path: Path) -> None:
    data, seen = period_stream()
    headers, packets, _ = period_packets()
    ends = [record.end for record in scan_records(data) if record.type in (RecordType.KEY, RecordType.DELTA)]
    path = tmp_path / "cut.sgs"
    borders = [place for start, end in offsets(RecordType.INIT) for place in (start, start + 3, end - 1, end)]
    for cut in sorted({*borders, *ends[::3], ends[4] - 1, len(data) - 1, len(data)}):
        path.write_bytes(data[:cut])
        frames = sum(end <= cut for end in ends)
        if cut > offsets(RecordType.INIT)[0][1]:
            reader = StreamReader(data[:cut])
            assert (len(reader), reader.complete) == (frames, cut == len(data) or cut >= len(data) - 16)
            assert not frames or same(reader.scene(frames - 1), seen[frames - 1])
        sink, resumed = FileSink.resume(path)
        write_packets(sink, headers, packets, start=0 if resumed is None else len(resumed))
        assert path.read_bytes() == data, cut


def test_an_orderly_stop_where_a_period_would_begin_leaves_nothing_of_it() -> None:
    headers, packets, _ = period_packets()
    sink, other = MemorySink(), MemorySink()
    for one in (sink, other):
        one.open(headers[0])
        for packet in packets[:4]:
            one.write(packet)
    sink.begin(headers[1])
    sink.close()
    other.close()
    assert sink.data == other.data


def test_periods_that_contradict_each_other_are_refused() -> None:
    data, _ = period_stream()
    (_, _), (start, end), _ = offsets(RecordType.INIT)
    init, key = data[start:end], next(one for one in scan_records(data, end))
    packet = key.payload
    delta = packed(RecordType.DELTA, packet, period=1)
    cases = {
        "init record of period 2, .* where one of period 1": packed(
            RecordType.INIT, pack_header(period_header(1)), period=2
        ),
        "init record of period 1, .* where one of period 2": init + init,
        "Period 1 of The stream begins with a delta packet": init + delta,
        "packet of period 0, at byte .*, after the init record of period 1": init + packed(RecordType.KEY, packet),
        "packet of period 1, at byte .*, after the init record of period 0": packed(RecordType.KEY, packet, period=1),
        "has packet 9 where packet 4 belongs": init
        + packed(RecordType.KEY, struct.pack("<Id", 9, 1.0) + packet[12:], period=1),
    }
    for message, records in cases.items():
        with pytest.raises(StreamError, match=message):
            StreamReader(data[:start] + records)


def test_an_index_that_leaves_out_a_period_is_not_believed() -> None:
    """Otherwise the frames of a period would be decoded with another one's header."""
    data, seen = period_stream()
    *_, index = scan_records(data)
    entries = [*INDEX_ENTRY.iter_unpack(index.payload)]
    for left_out in ([RecordType.INIT], []):
        kept = [entry for entry in entries if entry[1] not in left_out]
        body = data[: index.offset] + pack_index(kept, index.offset)
        start = offsets(RecordType.INIT)[0][1]
        assert (read_index(body, start) is None) == bool(left_out)
        reader = StreamReader(body, by_index=True)
        assert same(reader.scene(5), seen[5])


def test_an_init_record_damaged_after_opening_costs_its_period(tmp_path: Path) -> None:
    data, seen = period_stream()
    path = tmp_path / "late.sgs"
    path.write_bytes(flipped(data, 8 * (offsets(RecordType.INIT)[1][0] + 40)))
    with open_stream(path, by_index=True) as reader:
        assert same(reader.scene(3), seen[3])
        with pytest.raises(StreamError, match="The init record of period 1 of .*late.sgs, at byte .*, is damaged"):
            reader.scene(4)
        assert same(reader.scene(9), seen[9])


CODEC = "raw"


@cache
def inits() -> list[Record]:
    """The init records of a stream of three periods."""
    data, _ = period_stream(codec=CODEC)
    return [record for record in scan_records(data) if record.type == RecordType.INIT]


def table() -> PeriodTable:
    """The table of the stream before a second period is found."""
    return PeriodTable(period_stream(codec=CODEC)[0], "a.sgs", inits()[0])


@pytest.mark.parametrize("kind", [RecordType.INIT, RecordType.KEY])
def test_a_whole_record_of_another_number_or_type_is_refused(kind: RecordType) -> None:
    record = packed(kind, inits()[1].payload, period=1 if kind == RecordType.KEY else 2)
    found = PeriodTable(record, "a.sgs", inits()[0])
    found.periods.append(Period(1, 4, 0, len(record)))
    with pytest.raises(StreamError, match="period 1 of a.sgs, at byte 0, is damaged"):
        found.header(1)


def other_near(header: StreamHeader) -> StreamHeader:
    rig = header.rig
    name = next(iter(rig))
    return replace(header, rig=replace(rig, cameras={**rig.cameras, name: replace(rig[name], near=0.5)}))


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (lambda header: replace(header, rig=arc_rig(len(list(header.rig)), radius=3.1)), "cameras"),
        (other_near, "cameras"),
        (lambda header: replace(header, rig=header.rig.with_held_out(frozenset([[*header.rig][-1]]))), "cameras"),
        (lambda header: replace(header, similarity=Similarity((0.1, -0.25, 3.5), 0.7)), "similarity"),
        (lambda header: replace(header, similarity=Similarity((0.1, -0.25, 3.0), 0.8)), "similarity"),
        (lambda header: replace(header, fps=25.0), "frames a second"),
        (lambda header: period_header(1, codec="compact"), "codec"),
    ],
)
def test_a_header_of_another_stream_is_refused(change, what: str) -> None:
    found = table()
    changed = change(period_header(1, codec=CODEC))
    assert differences(found.first, changed) == [what]
    record = Record(RecordType.INIT, pack_header(changed), 777, 1)
    message = f"The init record of period 1 of a.sgs, at byte 777, has other {what} than the first"
    with pytest.raises(StreamError, match=message):
        found.check(record)


def test_what_may_change_from_period_to_period_does() -> None:
    changed = replace(period_header(2, codec=CODEC), config={"seed": 9}, metadata={"note": "later"})
    header = table().check(Record(RecordType.INIT, pack_header(changed), 0, 1))
    assert (header.config, header.metadata) == ({"seed": 9}, {"note": "later"})

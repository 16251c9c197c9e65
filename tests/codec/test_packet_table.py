# SPDX-License-Identifier: Apache-2.0
"""Facts of packets and packets by frame, from offsets alone; damage after opening is never believed."""

from contextlib import suppress
from functools import cache

import pytest
from hypothesis import given
from hypothesis import strategies as st

from structgstream.codec.container.records import Record, RecordType, packed, scan_records
from structgstream.codec.contents import LOST, Packets
from structgstream.codec.packets import PacketKind
from structgstream.errors import StreamError
from tests.support.properties import examples
from tests.support.streams import small_stream

FRAMES = 5


@cache
def records() -> list[Record]:
    return [record for record in scan_records(whole()) if record.type in (RecordType.KEY, RecordType.DELTA)]


@cache
def whole() -> bytes:
    return small_stream(FRAMES)


def table(data: bytes | bytearray, *, offsets: list[int] | None = None) -> Packets:
    """The packets of a stream; without ``offsets`` those of :func:`whole`."""
    found = Packets(memoryview(data), "a.sgs")
    found.offsets.extend([record.offset for record in records()] if offsets is None else offsets)
    found.whole = len(found.offsets)
    return found


def test_facts_are_those_of_the_records() -> None:
    found = table(whole())
    assert len(found) == FRAMES
    for index, (info, record) in enumerate(zip(found, records(), strict=True)):
        assert info.kind is (PacketKind.DELTA if index % 3 else PacketKind.KEY)
        assert (info.index, info.pts_seconds, info.offset) == (index, index / 30.0, record.offset)
        assert info.bytes == record.end - record.offset
        # The payload begins with frame and time, 12 bytes; the rest are blocks of fields.
        assert sum(info.field_bytes.values()) == len(record.payload) - 12


def test_packets_are_those_of_the_records() -> None:
    found = table(whole())
    for index, record in enumerate(records()):
        packet = found.packet(index)
        assert (packet.index, packet.payload) == (index, record.payload)


@given(st.slices(FRAMES), st.integers(-FRAMES, FRAMES - 1))
def test_it_is_indexed_as_a_list(part: slice, index: int) -> None:
    found = table(whole())
    listed = [*found]
    assert found[part] == listed[part]
    assert found[index] == listed[index]


@pytest.mark.parametrize("index", [FRAMES, -FRAMES - 1])
def test_beyond_the_last_whole_packet_there_is_none(index: int) -> None:
    with pytest.raises(IndexError):
        table(whole())[index]


def test_packets_after_a_lost_one_are_found_by_their_frame() -> None:
    offsets = [record.offset for record in records()]
    found = table(whole(), offsets=[*offsets[:2], LOST, *offsets[3:]])
    found.whole = 2
    assert [info.index for info in found] == [0, 1]
    with pytest.raises(IndexError):
        found[3]
    assert (found.at(3).index, found.packet(4).index) == (3, 4)
    for ask in (found.at, found.packet):
        with pytest.raises(StreamError, match=r"Packet 2 of a\.sgs, at byte \d+, is damaged\."):
            ask(2)


@examples(200)
@given(st.data())
def test_any_flipped_bit_of_a_packet_is_noticed_and_facts_are_never_a_crash(choice: st.DataObject) -> None:
    index = choice.draw(st.integers(0, FRAMES - 1))
    record = records()[index]
    # Mostly heads, where facts come from.
    head = st.integers(8 * record.offset, 8 * (record.offset + 40) - 1)
    bit = choice.draw(head | st.integers(8 * record.offset, 8 * record.end - 1))
    data = bytearray(whole())
    data[bit // 8] ^= 1 << bit % 8
    found = table(data)
    with pytest.raises(StreamError):
        found.packet(index)
    with suppress(StreamError):
        assert found.at(index).index == index
    for other in {*range(FRAMES)} - {index}:
        assert found.packet(other).payload == records()[other].payload


@pytest.mark.parametrize(("kind", "frame"), [(RecordType.INIT, 1), (77, 1), (RecordType.DELTA, 2)])
def test_a_whole_record_that_is_not_the_packet_is_refused(kind: int, frame: int) -> None:
    record = packed(kind, records()[frame].payload)
    found = table(whole() + record, offsets=[records()[0].offset, len(whole())])
    for ask in (found.at, found.packet):
        with pytest.raises(StreamError, match=rf"Packet 1 of a\.sgs, at byte {len(whole())}, is damaged"):
            ask(1)


def test_a_short_packet_is_refused() -> None:
    found = table(whole() + packed(RecordType.KEY, b"short"), offsets=[len(whole())])
    for ask in (found.at, found.packet):
        with pytest.raises(StreamError, match=r"damaged|too short"):
            ask(0)


def test_what_a_whole_record_states_of_its_fields_is_checked() -> None:
    """A record that was written like this says what is wrong with it, not that it was damaged."""
    payload = records()[0].payload[:12] + bytes([250, 0, 0, 0])
    with pytest.raises(StreamError, match=r"Packet 0 holds a field block .*install a newer structgstream"):
        table(whole() + packed(RecordType.KEY, payload), offsets=[len(whole())]).at(0)

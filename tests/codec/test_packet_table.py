# SPDX-License-Identifier: Apache-2.0
"""Facts of packets and packets by frame, from offsets alone; damage after opening is never believed."""

from contextlib import suppress
from functools import cache

import pytest
from hypothesis import given
from hypothesis import strategies as st

from structgstream.codec.container.records import Record, RecordType, packed, scan_records
from structgstream.codec.contents import LOST, Packets
from structgstream.errors import StreamError
from tests.support.properties import examples
from tests.support.streams import flipped, small_stream

FRAMES = 5


@cache
def records() -> list[Record]:
    return [record for record in scan_records(whole()) if record.type in (RecordType.KEY, RecordType.DELTA)]


@cache
def whole() -> bytes:
    return small_stream(FRAMES)


def table(data: bytes, *, offsets: list[int] | None = None) -> Packets:
    """The packets of a stream; without ``offsets`` those of :func:`whole`."""
    found = Packets(data, "a.sgs")
    found.offsets.extend([record.offset for record in records()] if offsets is None else offsets)
    found.whole = len(found.offsets)
    return found


def test_packets_after_a_lost_one_are_found_by_their_frame() -> None:
    offsets = [record.offset for record in records()]
    found = table(whole(), offsets=[*offsets[:2], LOST, *offsets[3:]])
    found.whole = 2
    assert [info.index for info in found] == [info.index for info in found[:]] == [0, 1]
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
    found = table(flipped(whole(), bit))
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

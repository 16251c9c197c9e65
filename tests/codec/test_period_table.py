# SPDX-License-Identifier: Apache-2.0
"""The headers of periods, read when they are asked for: damaged ones, and those of another stream, are refused."""

from dataclasses import replace
from functools import cache

import pytest
from hypothesis import given
from hypothesis import strategies as st

from structgstream.cameras import Similarity
from structgstream.codec.container.records import Period, Record, RecordType, packed, scan_records
from structgstream.codec.contents import PeriodTable, differences
from structgstream.codec.packets import StreamHeader, pack_header
from structgstream.errors import StreamError
from tests.support.period_streams import FIRSTS, FRAMES, LENGTHS, period_header, period_of, period_stream
from tests.support.properties import examples
from tests.support.rigs import arc_rig

CODEC = "raw"


@cache
def inits() -> list[Record]:
    """The init records of a stream of three periods."""
    data, _ = period_stream(codec=CODEC)
    return [record for record in scan_records(data) if record.type == RecordType.INIT]


def table(data: bytes | bytearray | None = None) -> PeriodTable:
    """The table of the stream, or of damaged bytes of it, as it is after opening."""
    found = PeriodTable(memoryview(period_stream(codec=CODEC)[0] if data is None else data), "a.sgs", inits()[0])
    for first, record in zip(FIRSTS[1:], inits()[1:], strict=True):
        found.periods.append(Period(record.period, first, record.offset, record.end - record.offset))
    return found


def test_a_table_begins_with_the_first_period() -> None:
    found = PeriodTable(b"", "a.sgs", inits()[0])
    assert found.periods == [Period(0, 0, inits()[0].offset, inits()[0].end - inits()[0].offset)]
    assert found.header(0) is found.first


def test_each_frame_has_the_header_of_its_period() -> None:
    found = table()
    for frame in (*range(FRAMES), *reversed(range(FRAMES))):
        place = found.place(frame)
        assert place == period_of(frame)
        # The scenes of period p have 3 + p anchors.
        assert found.header(place).static["base_scales"].shape[0] == 3 + place


def test_one_header_besides_the_first_is_kept() -> None:
    found = table()
    first = found.header(1)
    assert found.header(1) is first
    found.header(0)
    assert found.header(1) is first
    found.header(2)
    assert found.header(1) is not first


def test_bytes_of_fields_are_those_of_the_periods_own_record() -> None:
    found = table()
    sizes = [found.field_bytes(place) for place in range(len(LENGTHS))]
    assert sizes[0]["base_scales"] < sizes[1]["base_scales"] < sizes[2]["base_scales"]
    assert all(sum(size.values()) < len(record.payload) for size, record in zip(sizes, inits(), strict=True))


@examples(150)
@given(st.data())
def test_any_flipped_bit_of_a_later_init_record_is_noticed(choice: st.DataObject) -> None:
    place = choice.draw(st.integers(1, len(LENGTHS) - 1))
    record = inits()[place]
    bit = choice.draw(st.integers(8 * record.offset, 8 * record.end - 1))
    data = bytearray(period_stream(codec=CODEC)[0])
    data[bit // 8] ^= 1 << bit % 8
    found = table(data)
    message = rf"The init record of period {place} of a\.sgs, at byte {record.offset}, is damaged\."
    for ask in (found.header, found.field_bytes):
        with pytest.raises(StreamError, match=message):
            ask(place)
    other = 3 - place
    assert found.header(other).static["base_scales"].shape[0] == 3 + other


@pytest.mark.parametrize("kind", [RecordType.INIT, RecordType.KEY])
def test_a_whole_record_of_another_number_or_type_is_refused(kind: RecordType) -> None:
    record = packed(kind, inits()[1].payload, period=1 if kind == RecordType.KEY else 2)
    found = PeriodTable(record, "a.sgs", inits()[0])
    found.periods.append(Period(1, 4, 0, len(record)))
    with pytest.raises(StreamError, match="period 1 of a.sgs, at byte 0, is damaged"):
        found.header(1)


def other_near(header: StreamHeader) -> StreamHeader:
    rig = header.rig
    cameras = {name: rig[name] for name in rig}
    name = next(iter(cameras))
    return replace(header, rig=replace(rig, cameras=cameras | {name: replace(cameras[name], near=0.5)}))


def other_held_out(header: StreamHeader) -> StreamHeader:
    return replace(header, rig=replace(header.rig, held_out=frozenset([list(header.rig)[-1]])))


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (lambda header: replace(header, rig=arc_rig(len(list(header.rig)), radius=3.1)), "cameras"),
        (other_near, "cameras"),
        (other_held_out, "cameras"),
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


def test_a_first_record_that_is_no_header_is_refused() -> None:
    with pytest.raises(StreamError):
        PeriodTable(b"", "a.sgs", Record(RecordType.INIT, b"nothing", 12))

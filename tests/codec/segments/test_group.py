# SPDX-License-Identifier: Apache-2.0
"""Parts, and the segment that they become."""

import hashlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from structgstream.codec.container.records import FRAME, PacketKind, RecordType, packed
from structgstream.codec.segments.recovery import part_of, records_of, segment_of
from structgstream.errors import StreamError
from tests.support.properties import examples


def record(frame: int, *, key: bool, content: bytes = b"", period: int = 0) -> bytes:
    kind = RecordType.KEY if key else RecordType.DELTA
    return packed(kind, FRAME.pack(frame, frame / 30.0) + content, period=period)


@given(st.integers(0, 2**32 - 1), st.booleans(), st.binary(max_size=50), st.integers(0, 2**16 - 1))
@examples(200)
def test_a_part_states_what_its_record_holds(frame: int, key: bool, content: bytes, period: int) -> None:
    data = record(frame, key=key, content=content, period=period)
    part = part_of(data)
    digest = hashlib.sha256(data).hexdigest()
    assert (part.frame, part.pts_seconds, part.period, part.bytes) == (frame, frame / 30.0, period, len(data))
    assert part.kind is (PacketKind.KEY if key else PacketKind.DELTA)
    assert (part.sha256, part.file) == (digest, f"part-{frame:08d}-{digest[:16]}.sgs")


@given(st.integers(0, 1000), st.lists(st.binary(max_size=20), min_size=1, max_size=6), st.integers(0, 10**9))
@examples(200)
def test_a_segment_is_its_parts_and_gives_them_back(first: int, contents: list[bytes], number: int) -> None:
    records = [record(first + i, key=i == 0, content=content, period=3) for i, content in enumerate(contents)]
    parts = [part_of(one) for one in records]
    data = b"".join(records)
    entry = segment_of(parts, data, segment=number)
    assert (entry.segment, entry.period, entry.first_frame, entry.frames) == (number, 3, first, len(records))
    assert entry.pts_seconds == (first / 30.0, (first + len(records) - 1) / 30.0)
    assert (entry.bytes, entry.key_bytes, sum(entry.frame_bytes)) == (len(data), len(records[0]), len(data))
    assert entry.sha256 == hashlib.sha256(data).hexdigest()
    assert entry.file == f"segment-{number:08d}-{entry.sha256[:16]}.sgs"
    assert records_of(entry, data) == records
    assert [part_of(one) for one in records_of(entry, data)] == parts


@pytest.mark.parametrize(
    "data",
    [
        b"",
        record(0, key=True)[:-1],
        record(0, key=True)[:-1] + b"x",
        packed(RecordType.INIT, bytes(12)),
        packed(RecordType.INDEX, bytes(13)),
        packed(RecordType.KEY, bytes(11)),
    ],
)
def test_what_is_no_packet_is_no_part(data: bytes) -> None:
    with pytest.raises(StreamError, match=f"^{len(data)} bytes are no whole record of a packet"):
        part_of(data)


def test_an_empty_packet_is_one() -> None:
    assert part_of(packed(RecordType.KEY, bytes(12))).frame == 0

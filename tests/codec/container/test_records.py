# SPDX-License-Identifier: Apache-2.0
import struct
import zlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from structgstream.codec.container import records
from structgstream.codec.container.records import (
    RecordType,
    check_prefix,
    incomplete_reason,
    packed,
    prefix,
    read_record,
    scan_records,
)
from structgstream.errors import StreamError
from tests.support.streams import flipped


def test_the_layout_of_a_record() -> None:
    head = bytes([2, 0, 0, 0, 3, 0, 0, 0])
    assert packed(RecordType.KEY, b"abc") == head + b"abc" + struct.pack("<I", zlib.crc32(head + b"abc"))
    assert prefix() == b"\x89SGS\r\n\x1a\n\x02\x00\x00\x00"


@given(st.lists(st.binary(max_size=20), max_size=5))
def test_records_come_back(payloads: list[bytes]) -> None:
    data = prefix() + b"".join(packed(RecordType.DELTA, payload) for payload in payloads)
    found = list(scan_records(data))
    assert [record.payload for record in found] == payloads
    assert [record.offset for record in found] + [len(data)] == [12] + [record.end for record in found]


@given(st.binary(max_size=30), st.data())
def test_any_flipped_bit_is_noticed(payload: bytes, choice: st.DataObject) -> None:
    record = packed(RecordType.KEY, payload)
    bit = choice.draw(st.integers(0, 8 * len(record) - 1))
    assert read_record(flipped(record, bit), 0) is None


@given(st.binary(max_size=64))
def test_arbitrary_bytes_end_the_scan_without_an_error(data: bytes) -> None:
    assert all(record.end <= len(data) + 12 for record in scan_records(prefix() + data))


def test_a_length_beyond_the_file_is_not_believed() -> None:
    assert read_record(struct.pack("<BBHI", 2, 0, 0, 2**32 - 1) + b"abc", 0) is None


def test_why_reading_stopped() -> None:
    data = packed(RecordType.KEY, b"abc")
    assert incomplete_reason(data, len(data)) == "it ends at byte 15 without an index"
    assert incomplete_reason(data[:-1], 0) == "it is cut at byte 14, within the record that begins at byte 0"
    assert incomplete_reason(data[:5], 0) == "it is cut at byte 5, within the record that begins at byte 0"
    assert incomplete_reason(b"\x03" + data[1:], 0) == "the record at byte 0 of 15 is damaged"


def test_a_payload_must_fit_its_length_field(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(records, "MAX_RECORD_BYTES", 3)
    assert packed(RecordType.KEY, b"abc")
    with pytest.raises(StreamError, match="4 bytes is too long; the format holds 3"):
        packed(RecordType.KEY, b"abcd")


@pytest.mark.parametrize("data", [b"\x89PNG\r\n\x1a\n\x01\x00\x00\x00", b"abc", b"\x89SGS\r\n\n\x01\x00\x00\x00\x00"])
def test_another_signature(data: bytes) -> None:
    with pytest.raises(StreamError, match="x.sgs is not a structgstream file"):
        check_prefix(data, "x.sgs")


def test_a_prefix_cut_short() -> None:
    with pytest.raises(StreamError, match=r"x\.sgs is cut at byte 10"):
        check_prefix(prefix()[:10], "x.sgs")

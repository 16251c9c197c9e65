# SPDX-License-Identifier: Apache-2.0
"""Index and footer: offsets of packets for random access (docs/bitstream.md, section Index record and footer)."""

import struct
from array import array
from collections.abc import Iterable

from structgstream.codec.container.byte_source import ByteSource
from structgstream.codec.container.packet_head import FRAME
from structgstream.codec.container.records import (
    CHECKSUM,
    FOOTER,
    FOOTER_MAGIC,
    RECORD,
    RecordType,
    footer_offset,
    packed,
    read_head,
    read_record,
)

INDEX_ENTRY = struct.Struct("<IBQ")  # frame index, record type, offset


def pack_index(entries: Iterable[tuple[int, int, int]], offset: int) -> bytes:
    """Index record, to be written at byte ``offset``, and footer; entries: frame index, record type, offset."""
    index = b"".join(INDEX_ENTRY.pack(*entry) for entry in entries)
    return packed(RecordType.INDEX, index) + FOOTER.pack(offset, FOOTER_MAGIC)


def read_index_offsets(data: ByteSource, start: int) -> "array[int] | None":
    """Offsets, from the index, of the packets from byte ``start`` on; None if the stream must be scanned.

    The index is not used if footer or index is damaged, or disagrees with the heads of the records.
    """
    end = footer_offset(data)
    if end is None or end < start:
        return None
    index = read_record(data, end)
    if index is None or len(index.payload) % INDEX_ENTRY.size:
        return None
    found = _by_heads(data, start, end)
    if found is None or found != index.payload:
        return None
    return array("Q", (offset for _, _, offset in INDEX_ENTRY.iter_unpack(found)))


def _by_heads(data: ByteSource, start: int, end: int) -> bytearray | None:
    """The expected entries of the index, from the records' heads; None if the sequence of packets is invalid."""
    entries = bytearray()
    before_seconds = 0.0
    while start < end:
        if (head := read_head(data, start)) is None:
            return None
        kind, length = head
        if kind in (RecordType.KEY, RecordType.DELTA):
            count = len(entries) // INDEX_ENTRY.size
            if length < FRAME.size or (kind == RecordType.DELTA and not count):
                return None
            number, pts_seconds = FRAME.unpack(data[start + RECORD.size : start + RECORD.size + FRAME.size])
            if number != count or (count and not pts_seconds > before_seconds):
                return None
            before_seconds = pts_seconds
            entries += INDEX_ENTRY.pack(number, kind, start)
        elif kind in (RecordType.INIT, RecordType.INDEX):
            return None
        start += RECORD.size + length + CHECKSUM.size
    return entries if start == end else None

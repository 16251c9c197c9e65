# SPDX-License-Identifier: Apache-2.0
"""Periods, index and footer: offsets for random access (docs/bitstream.md, Periods, Index record and footer)."""

import struct
from array import array
from bisect import bisect_right
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from structgstream.codec.container.byte_source import ByteSource
from structgstream.codec.container.records import (
    FOOTER,
    FOOTER_MAGIC,
    FRAME,
    RECORD,
    Head,
    RecordType,
    footer_offset,
    packed,
    read_head,
    read_record,
)


@dataclass(frozen=True)
class Period:
    """Where a period begins.

    Args:
        number: as stated by its records; 0 for the first of a stream.
        first_frame: its first whole packet's.
        offset: of its init record.
        bytes: of its init record.
    """

    number: int
    first_frame: int
    offset: int
    bytes: int


def period_at(periods: Sequence[Period], frame: int) -> int:
    """The place in ``periods`` of the one that a frame belongs to."""
    return max(bisect_right(periods, frame, key=lambda period: period.first_frame) - 1, 0)


INDEX_ENTRY = struct.Struct("<IBQ")  # frame index, record type, offset


@dataclass(frozen=True)
class Index:
    """What an index says.

    Args:
        offsets: of packets, by frame.
        periods: those after the first.
    """

    offsets: "array[int]"
    periods: tuple[Period, ...]


def pack_index(entries: Iterable[tuple[int, int, int]], offset: int) -> bytes:
    """Index record, to be written at byte ``offset``, and footer.

    Args:
        entries: frame index, record type and offset of each packet, and of each init record after the first.
        offset: where the index record begins.
    """
    index = b"".join(INDEX_ENTRY.pack(*entry) for entry in entries)
    return packed(RecordType.INDEX, index) + FOOTER.pack(offset, FOOTER_MAGIC)


def indexed_frames(payload: bytes) -> int:
    """How many packets an index record lists."""
    return sum(kind != RecordType.INIT for _, kind, _ in INDEX_ENTRY.iter_unpack(payload))


def read_index(data: ByteSource, start: int, *, period: int = 0) -> Index | None:
    """Offsets, from the index, of the packets from byte ``start`` on; None if the stream must be scanned.

    The index is not used if footer or index is damaged, or disagrees with the heads of the records.

    Args:
        data: the stream.
        start: the end of its first init record.
        period: the number that this states.
    """
    end = footer_offset(data)
    if end is None or end < start:
        return None
    index = read_record(data, end)
    if index is None or len(index.payload) % INDEX_ENTRY.size:
        return None
    heads = _Heads(period)
    while start < end:
        if (head := read_head(data, start)) is None or not heads.add(data, head, start):
            return None
        start += head.bytes
    if start != end or heads.pending is not None or heads.entries != index.payload:
        return None
    return Index(heads.offsets, tuple(heads.periods))


class _Heads:
    """The expected entries of the index, from the records' heads in order."""

    def __init__(self, period: int) -> None:
        self.entries = bytearray()
        self.offsets: array[int] = array("Q")
        self.periods: list[Period] = []
        self.pending: Period | None = None  # its first packet has not come
        self._number = period
        self._seconds = 0.0

    def add(self, data: ByteSource, head: Head, offset: int) -> bool:
        """Take the record at ``offset``; False if it cannot be there."""
        if head.type == RecordType.INIT:
            return self._add_init(head, offset)
        if head.type in (RecordType.KEY, RecordType.DELTA):
            return self._add_packet(data, head, offset)
        return head.type != RecordType.INDEX

    def _add_init(self, head: Head, offset: int) -> bool:
        count = len(self.offsets)
        if self.pending is not None or not count or head.period != self._number + 1:
            return False
        self._number = head.period
        self.pending = Period(head.period, count, offset, head.bytes)
        self.entries += INDEX_ENTRY.pack(count, head.type, offset)
        return True

    def _add_packet(self, data: ByteSource, head: Head, offset: int) -> bool:
        count, begins = len(self.offsets), self.pending is not None or not self.offsets
        if head.length < FRAME.size or head.period != self._number or (begins and head.type != RecordType.KEY):
            return False
        frame, pts_seconds = FRAME.unpack(data[offset + RECORD.size : offset + RECORD.size + FRAME.size])
        if frame != count or (count and not pts_seconds > self._seconds):
            return False
        if self.pending is not None:
            self.periods.append(self.pending)
            self.pending = None
        self._seconds = pts_seconds
        self.offsets.append(offset)
        self.entries += INDEX_ENTRY.pack(frame, head.type, offset)
        return True

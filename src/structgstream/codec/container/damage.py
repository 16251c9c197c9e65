# SPDX-License-Identifier: Apache-2.0
"""Resynchronisation after a damaged record (docs/bitstream.md, section Damage)."""

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass

from structgstream.codec.container.byte_source import ByteSource
from structgstream.codec.container.index import INDEX_ENTRY
from structgstream.codec.container.packet_head import FRAME
from structgstream.codec.container.records import CHECKSUM, RECORD, Record, RecordType, read_head, read_record

LEAST_PACKET_BYTES = RECORD.size + FRAME.size + CHECKSUM.size
_CHUNK_BYTES = 2**20
_WORK = 4
_HEAD = re.compile(rb"[\x02-\x04].\x00\x00", re.DOTALL)


@dataclass(frozen=True)
class Damage:
    """A damaged record that whole records follow.

    Args:
        offset: its first byte.
        frames: the frames lost to it: its own, and those up to the next key packet.
    """

    offset: int
    frames: range


def next_index(record: Record) -> int:
    """A packet's frame number; for an index, the number of frames."""
    if record.type == RecordType.INDEX:
        return len(record.payload) // INDEX_ENTRY.size
    return int(FRAME.unpack_from(record.payload)[0])


class PacketSearch:
    """Finds whole records after damage in ``data``.

    Use one object per stream: all its calls together verify checksums of at most four times the stream's bytes, which
    bounds the work that a malicious file can cause.
    """

    def __init__(self, data: ByteSource) -> None:
        self._data = data
        self._left = _WORK * len(data)

    def next(self, damaged: int, *, expected: int, after_seconds: float) -> Record | None:
        """The first whole packet or index after byte ``damaged``, where a record is not whole.

        Args:
            damaged: where that record begins.
            expected: number of the next frame.
            after_seconds: presentation time of the last frame.
        """
        for offset in self._heads(damaged + 1):
            if not self._fits(offset, damaged, expected, after_seconds):
                continue
            head = read_head(self._data, offset)
            assert head is not None, "it fits"
            self._left -= head[1]
            if self._left < 0:
                return None
            if (record := read_record(self._data, offset)) is not None:
                return record
        return None

    def _heads(self, start: int) -> Iterator[int]:
        """Offsets from ``start`` on that may be the head of a packet or an index."""
        while start + RECORD.size <= len(self._data):
            chunk = bytes(self._data[start : start + _CHUNK_BYTES])
            at = 0
            while (match := _HEAD.search(chunk, at)) is not None:
                at = match.start() + 1
                yield start + match.start()
            start += max(len(chunk) - RECORD.size + 1, 1)

    def _fits(self, offset: int, damaged: int, expected: int, after_seconds: float) -> bool:
        """Whether a record at ``offset`` is consistent with ``expected`` frames before the damage."""
        if (head := read_head(self._data, offset)) is None:
            return False
        kind, length = head
        last = expected + (offset - damaged) // LEAST_PACKET_BYTES
        if kind == RecordType.INDEX:
            return length % INDEX_ENTRY.size == 0 and expected <= length // INDEX_ENTRY.size <= last
        if length < FRAME.size:
            return False
        start = offset + RECORD.size
        index, pts_seconds = FRAME.unpack(self._data[start : start + FRAME.size])
        return expected <= index <= last and math.isfinite(pts_seconds) and pts_seconds > after_seconds

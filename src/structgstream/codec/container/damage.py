# SPDX-License-Identifier: Apache-2.0
"""Damaged and cut streams: where whole records go on, and a writer may (docs/bitstream.md, section Damage)."""

import math
import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace

from structgstream.codec.container.blocks import LENGTH, read_description
from structgstream.codec.container.byte_source import ByteSource
from structgstream.codec.container.records import (
    CHECKSUM,
    FRAME,
    INDEX_ENTRY,
    PREFIX,
    RECORD,
    Head,
    Record,
    RecordType,
    check_prefix,
    incomplete_reason,
    indexed_frames,
    may_be_prefix,
    read_record,
    scan_records,
)
from structgstream.errors import StreamError

MIN_PACKET_BYTES = RECORD.size + FRAME.size + CHECKSUM.size
_ZSTD = bytes.fromhex("28b52ffd")  # which an init record's description begins with
_CHUNK_BYTES = 2**20
_WORK = 4


@dataclass(frozen=True)
class Damage:
    """A damaged record that whole records follow.

    Args:
        offset: its first byte.
        frames: the frames lost to it: its own, and those up to the next key packet.
    """

    offset: int
    frames: range


@dataclass(frozen=True)
class Standing:
    """What is known of a stream where a record is not whole.

    Args:
        offset: where that record begins; of several in a row without a whole packet between them, where the first does.
        frames: number of the next frame.
        seconds: presentation time of the last frame.
        period: number of the last whole init record.
    """

    offset: int
    frames: int
    seconds: float
    period: int = 0

    def last_frame_at(self, offset: int) -> int:
        """The last frame that a packet at ``offset`` may be: frames before it take bytes, too."""
        return self.frames + (offset - self.offset) // MIN_PACKET_BYTES


class PacketSearch:
    """Finds whole records after damage in ``data``.

    Use one object per stream: all its calls together verify checksums of at most four times the stream's bytes, which
    bounds the work that a malicious file can cause.
    """

    def __init__(self, data: ByteSource) -> None:
        self._data = data
        self._left = _WORK * len(data)

    def next(self, damaged: int, standing: Standing) -> Record | None:
        """The first whole packet, init record or index after byte ``damaged``, where a record is not whole."""
        for offset, head in self._heads(damaged + 1, standing.period):
            if not self._may_follow(head, offset, standing):
                continue
            self._left -= head.length
            if self._left < 0:
                return None
            record = read_record(self._data, offset)
            if record is not None and _fits(record, standing):
                return record
        return None

    def _heads(self, start: int, period: int) -> Iterator[tuple[int, Head]]:
        """What may be heads of such records from ``start`` on, and where; all of each record is there."""
        number = re.escape(period.to_bytes(2, "little"))
        pattern = re.compile(rb"\x01|[\x02\x03].%b|\x04.\x00\x00" % number, re.DOTALL)
        while start + RECORD.size <= len(self._data):
            chunk = bytes(self._data[start : start + _CHUNK_BYTES])
            at = 0
            while (match := pattern.search(chunk, at)) is not None and match.start() + RECORD.size <= len(chunk):
                offset, at = start + match.start(), match.start() + 1
                kind, _, of, length = RECORD.unpack_from(chunk, match.start())
                head = Head(kind, of, length)
                if offset + head.bytes <= len(self._data):
                    yield offset, head
            start += max(len(chunk) - RECORD.size + 1, 1)

    def _may_follow(self, head: Head, offset: int, standing: Standing) -> bool:
        """Whether a record at ``offset`` is, by its head, consistent with what is known before the damage."""
        last = standing.last_frame_at(offset)
        if head.type == RecordType.INIT:
            start = offset + RECORD.size + LENGTH.size
            return head.period > standing.period and bytes(self._data[start : start + len(_ZSTD)]) == _ZSTD
        if head.type == RecordType.INDEX:
            entries = head.length // INDEX_ENTRY.size
            return head.length % INDEX_ENTRY.size == 0 and standing.frames <= entries <= 2 * last
        if head.length < FRAME.size:
            return False
        start = offset + RECORD.size
        index, pts_seconds = FRAME.unpack(self._data[start : start + FRAME.size])
        return standing.frames <= index <= last and standing.seconds < pts_seconds < math.inf


def _fits(record: Record, standing: Standing) -> bool:
    """Whether an index lists as many frames as there may be; True for other records."""
    if record.type != RecordType.INDEX:
        return True
    return standing.frames <= indexed_frames(record.payload) <= standing.last_frame_at(record.offset)


def _states_sound(payload: bytes) -> bool:
    """Whether the description of an init record states sound; what is no description is reported by who reads it."""
    with suppress(StreamError, ValueError):
        return "sound" in read_description(payload)
    return False


def readable_part(data: ByteSource, *, name: str) -> int | None:
    """End of the last whole packet, before the index; None if the file is truncated within the init record.

    In a stream with sound, a packet counts when the sound record after it is whole: both are written at once.

    Raises:
        StreamError: not a stream, another major version, or a damaged init record, after which restarting would
            destroy frames.
    """
    if may_be_prefix(data[: PREFIX.size + 1]):
        return None  # Cut within the prefix, or empty.
    check_prefix(data, name)
    end, standing, complete = PREFIX.size, Standing(PREFIX.size, 0, -math.inf), False
    has_sound = False
    for record in scan_records(data):
        if complete := record.type == RecordType.INDEX:
            break
        standing = replace(standing, offset=record.end)
        if record.type == RecordType.INIT and record.offset > PREFIX.size:
            standing = replace(standing, period=record.period)
            continue  # What a period begins with is written with its first packet, and again when that is cut.
        is_packet = record.type in (RecordType.KEY, RecordType.DELTA)
        if not (is_packet and has_sound):
            end = record.end
        if record.type == RecordType.INIT:
            standing = replace(standing, period=record.period)
            has_sound = _states_sound(record.payload)
        elif is_packet:
            standing = replace(standing, frames=standing.frames + 1)
    # A crash cannot leave whole frames after a damaged one; a failing disk can.
    lost = not complete and PacketSearch(data).next(standing.offset, standing) is not None
    if end > PREFIX.size:
        if lost:
            raise StreamError(
                f"Cannot continue {name}: {incomplete_reason(data, standing.offset)}, and continuing would overwrite "
                f"the whole frames after it. Keep a copy, then truncate the file to {end} bytes and use --resume to "
                "fit them again."
            )
        return end
    reason = incomplete_reason(data, end)
    if lost or "damaged" in reason:
        raise StreamError(f"Cannot continue {name}: {reason}. Keep a copy; then start again with --overwrite.")
    return None

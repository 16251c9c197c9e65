# SPDX-License-Identifier: Apache-2.0
"""Records, which hold all data of a stream file, and a packet's head (docs/bitstream.md, section Records).

A file is the magic, the version, and a sequence of records. Records before a truncated or damaged one stay readable.
"""

import struct
import zlib
from array import array
from bisect import bisect_right
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum

from structgstream.codec.container.byte_source import ByteSource
from structgstream.errors import StreamError

MAGIC = b"\x89SGS\r\n\x1a\n"
MAJOR = 2
MINOR, MINOR_WITH_PERIODS, MINOR_WITH_SOUND = 0, 1, 2
"""Minor versions: of a stream of one period, of one that may have several, and of one with sound."""
PREFIX = struct.Struct("<8sHH")
RECORD = struct.Struct("<BBHI")
CHECKSUM = struct.Struct("<I")
FOOTER = struct.Struct("<Q8s")
FOOTER_MAGIC = b"SGSINDEX"
MAX_RECORD_BYTES = 2**32 - 1
MAX_PERIODS = 2**16


class RecordType(IntEnum):
    """Types of records; readers skip unknown ones."""

    INIT = 1
    KEY = 2
    DELTA = 3
    INDEX = 4
    SOUND = 32


class PacketKind(IntEnum):
    """A key packet needs only the header; a delta packet also needs the packet before it."""

    KEY = 1
    DELTA = 2


PACKET_KINDS: Mapping[int, PacketKind] = {RecordType.KEY: PacketKind.KEY, RecordType.DELTA: PacketKind.DELTA}
"""The kind of packet that a record of a type holds."""
RECORD_TYPES: Mapping[PacketKind, RecordType] = {kind: RecordType(type) for type, kind in PACKET_KINDS.items()}
"""The type of the record that holds a kind of packet."""


@dataclass(frozen=True)
class Head:
    """The head of a record: its type, the number of its period, and the length of its payload."""

    type: int
    period: int
    length: int

    @property
    def bytes(self) -> int:
        """Length of the whole record."""
        return RECORD.size + self.length + CHECKSUM.size


@dataclass(frozen=True)
class Record:
    """One record: its type, its payload, the offset of its first byte in the file, and the number of its period."""

    type: int
    payload: bytes
    offset: int
    period: int = 0

    @property
    def end(self) -> int:
        """Offset of the byte after the record."""
        return self.offset + RECORD.size + len(self.payload) + CHECKSUM.size


def prefix(*, periods: bool = False, sound: bool = False) -> bytes:
    """The first bytes of a file, which may have several ``periods``, or ``sound``."""
    return PREFIX.pack(MAGIC, MAJOR, MINOR_WITH_SOUND if sound else MINOR_WITH_PERIODS if periods else MINOR)


def may_be_prefix(data: bytes | memoryview) -> bool:
    """Whether ``data`` is the beginning of some prefix, perhaps all of it."""
    return any(one.startswith(bytes(data)) for one in (prefix(), prefix(periods=True), prefix(sound=True)))


def packed(kind: int, payload: bytes, *, period: int = 0) -> bytes:
    """A record as bytes: header, payload, CRC-32 of both; ``period`` is the one that an init record begins, or that a
    packet belongs to. Raises StreamError if the payload is longer than a record can hold, or there are too many
    periods."""
    if period >= MAX_PERIODS:
        raise StreamError(f"A stream has at most {MAX_PERIODS} periods; begin another one.")
    if len(payload) > MAX_RECORD_BYTES:
        raise StreamError(f"A record of {len(payload)} bytes is too long; the format holds {MAX_RECORD_BYTES}.")
    head = RECORD.pack(kind, 0, period, len(payload))
    return head + payload + CHECKSUM.pack(zlib.crc32(payload, zlib.crc32(head)))


def check_prefix(data: ByteSource, name: str) -> None:
    """Check that ``data`` is a stream of this major version. Raises StreamError if it is not."""
    if not prefix().startswith(bytes(data[: len(MAGIC)])):
        raise StreamError(f"{name} is not a structgstream file: its first bytes are not the format's signature.")
    if len(data) < PREFIX.size:
        raise StreamError(f"{name} is cut at byte {len(data)}, before its first frame.")
    _, major, minor = PREFIX.unpack(data[: PREFIX.size])
    if major != MAJOR:
        advice = "Reconstruct it again, or install the structgstream that wrote it."
        if major > MAJOR:
            advice = "Install a newer structgstream."
        raise StreamError(f"{name} has format version {major}.{minor}; this program reads {MAJOR}.x. {advice}")


def read_head(data: ByteSource, offset: int) -> Head | None:
    """The head of the record at ``offset``; None if the data ends before the end that it states."""
    if offset + RECORD.size + CHECKSUM.size > len(data):
        return None
    kind, _, period, length = RECORD.unpack(data[offset : offset + RECORD.size])
    head = Head(kind, period, length)
    return None if offset + head.bytes > len(data) else head


def read_record(data: ByteSource, offset: int) -> Record | None:
    """The record at ``offset``, or None if truncated or damaged. Its length is checked before anything is allocated."""
    if (head := read_head(data, offset)) is None:
        return None
    start = offset + RECORD.size
    end = start + head.length
    payload = bytes(data[start:end])
    checksum = CHECKSUM.pack(zlib.crc32(payload, zlib.crc32(data[offset:start])))
    if bytes(data[end : end + CHECKSUM.size]) != checksum:
        return None
    return Record(head.type, payload, offset, head.period)


def footer_offset(data: ByteSource) -> int | None:
    """Offset of the index record at the end of a complete stream; None if the stream is unfinished or truncated.

    Reads only the footer and the head of the index, so that a server can poll a growing file.
    """
    at = len(data) - FOOTER.size
    if at < PREFIX.size:
        return None
    offset, magic = FOOTER.unpack(data[at:])
    if magic != FOOTER_MAGIC or not PREFIX.size <= offset < at:
        return None
    head = read_head(data, offset)
    is_index = head is not None and head.type == RecordType.INDEX and offset + head.bytes == at
    return offset if is_index else None


def incomplete_reason(data: ByteSource, offset: int) -> str:
    """Why :func:`read_record` found no whole record at ``offset``, as a clause of a message."""
    if offset == len(data):
        return f"it ends at byte {offset} without an index"
    if read_head(data, offset) is not None:
        return f"the record at byte {offset} of {len(data)} is damaged"
    return f"it is cut at byte {len(data)}, within the record that begins at byte {offset}"


def scan_records(data: ByteSource, offset: int = PREFIX.size) -> Iterator[Record]:
    """Every record from byte ``offset`` on, up to the first truncated or damaged one."""
    while (record := read_record(data, offset)) is not None:
        yield record
        offset = record.end


FRAME = struct.Struct("<Id")  # index, presentation time in seconds


def read_frame(data: ByteSource, offset: int) -> tuple[int, float]:
    """Index and presentation time in the packet whose record is at ``offset``, of at least as many bytes."""
    start = offset + RECORD.size
    return FRAME.unpack(data[start : start + FRAME.size])


@dataclass(frozen=True)
class Period:
    """Where a period begins."""

    number: int  # as stated by its records; 0 for the first of a stream
    first_frame: int  # its first whole packet's
    offset: int  # of its init record
    bytes: int  # of its init record


def period_at(periods: Sequence[Period], frame: int) -> int:
    """The place in ``periods`` of the one that a frame belongs to."""
    return max(bisect_right(periods, frame, key=lambda period: period.first_frame) - 1, 0)


INDEX_ENTRY = struct.Struct("<IBQ")  # frame index, record type, offset


def pack_index(entries: Iterable[tuple[int, int, int]], offset: int) -> bytes:
    """Index record, to be written at byte ``offset``, and footer. Entries are frame index, record type and offset of
    each packet, and of each init record after the first."""
    index = b"".join(INDEX_ENTRY.pack(*entry) for entry in entries)
    return packed(RecordType.INDEX, index) + FOOTER.pack(offset, FOOTER_MAGIC)


def indexed_frames(payload: bytes) -> int:
    """How many packets an index record lists."""
    return sum(kind != RecordType.INIT for _, kind, _ in INDEX_ENTRY.iter_unpack(payload))


def read_index(data: ByteSource, start: int, *, period: int = 0) -> "tuple[array[int], list[Period]] | None":
    """Offsets, from the index, of the packets after the first init record, of ``period``, which ends at ``start``; and
    the periods after that one.

    None if the stream must be scanned: footer or index is damaged, or disagrees with the heads of the records.
    """
    end = footer_offset(data)
    if end is None or end < start:
        return None
    index = read_record(data, end)
    if index is None:
        return None
    offsets, periods, entries, seconds = array("Q"), list[Period](), bytearray(), 0.0
    while start < end:
        if (head := read_head(data, start)) is None or head.type == RecordType.INDEX:
            return None
        count = len(offsets)
        begins = count == (periods[-1].first_frame if periods else 0)  # a period, with its first packet
        if head.type == RecordType.INIT:
            if begins or head.period != period + 1:
                return None
            period = head.period
            periods.append(Period(period, count, start, head.bytes))
            entries += INDEX_ENTRY.pack(count, head.type, start)
        elif head.type in PACKET_KINDS:
            if head.length < FRAME.size or head.period != period or (begins and head.type != RecordType.KEY):
                return None
            frame, pts_seconds = read_frame(data, start)
            if frame != count or (count and not pts_seconds > seconds):
                return None
            seconds = pts_seconds
            offsets.append(start)
            entries += INDEX_ENTRY.pack(count, head.type, start)
        start += head.bytes
    is_empty = bool(periods) and periods[-1].first_frame == len(offsets)  # the last period
    return None if start != end or is_empty or entries != index.payload else (offsets, periods)

# SPDX-License-Identifier: Apache-2.0
"""Records, the containers of all data in a stream file (docs/bitstream.md, section Records).

A file is the magic, the version, and a sequence of records. Records before a truncated or damaged one stay readable.
"""

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum

from structgstream.codec.container.byte_source import ByteSource
from structgstream.errors import StreamError

MAGIC = b"\x89SGS\r\n\x1a\n"
MAJOR, MINOR = 2, 0
PREFIX = struct.Struct("<8sHH")
RECORD = struct.Struct("<BBHI")
CHECKSUM = struct.Struct("<I")
FOOTER = struct.Struct("<Q8s")
FOOTER_MAGIC = b"SGSINDEX"
MAX_RECORD_BYTES = 2**32 - 1


class RecordType(IntEnum):
    """Types of records; readers skip unknown ones."""

    INIT = 1
    KEY = 2
    DELTA = 3
    INDEX = 4


@dataclass(frozen=True)
class Record:
    """One record: its type, its payload, and the offset of its first byte in the file."""

    type: int
    payload: bytes
    offset: int

    @property
    def end(self) -> int:
        """Offset of the byte after the record."""
        return self.offset + RECORD.size + len(self.payload) + CHECKSUM.size


def prefix() -> bytes:
    """The first bytes of every file."""
    return PREFIX.pack(MAGIC, MAJOR, MINOR)


def packed(kind: int, payload: bytes) -> bytes:
    """A record as bytes: header, payload, CRC-32 of both.

    Raises:
        StreamError: the payload is longer than a record can hold.
    """
    if len(payload) > MAX_RECORD_BYTES:
        raise StreamError(f"A record of {len(payload)} bytes is too long; the format holds {MAX_RECORD_BYTES}.")
    head = RECORD.pack(kind, 0, 0, len(payload))
    return head + payload + CHECKSUM.pack(zlib.crc32(payload, zlib.crc32(head)))


def check_prefix(data: ByteSource, name: str) -> None:
    """Check that ``data`` is a stream of this major version.

    Raises:
        StreamError: it is not.
    """
    if not prefix().startswith(bytes(data[: len(MAGIC)])):
        raise StreamError(f"{name} is not a structgstream file: its first bytes are not the format's signature.")
    if len(data) < PREFIX.size:
        raise StreamError(f"{name} is cut at byte {len(data)}, before its first frame.")
    _, major, minor = PREFIX.unpack(data[: PREFIX.size])
    if major != MAJOR:
        newer, older = (
            "Install a newer structgstream.",
            "Reconstruct it again, or install the structgstream that wrote it.",
        )
        advice = newer if major > MAJOR else older
        raise StreamError(f"{name} has format version {major}.{minor}; this program reads {MAJOR}.x. {advice}")


def read_head(data: ByteSource, offset: int) -> tuple[int, int] | None:
    """Type and payload length stated by the record at ``offset``; None if the data ends before them."""
    if offset + RECORD.size + CHECKSUM.size > len(data):
        return None
    kind, _, _, length = RECORD.unpack(data[offset : offset + RECORD.size])
    return None if offset + RECORD.size + length + CHECKSUM.size > len(data) else (kind, length)


def read_record(data: ByteSource, offset: int) -> Record | None:
    """The record at ``offset``, or None if truncated or damaged. Its length is checked before anything is allocated."""
    if (head := read_head(data, offset)) is None:
        return None
    start = offset + RECORD.size
    end = start + head[1]
    payload = bytes(data[start:end])
    checksum = CHECKSUM.pack(zlib.crc32(payload, zlib.crc32(data[offset:start])))
    if bytes(data[end : end + CHECKSUM.size]) != checksum:
        return None
    return Record(head[0], payload, offset)


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
    if head is None or head[0] != RecordType.INDEX or offset + RECORD.size + head[1] + CHECKSUM.size != at:
        return None
    return offset


def incomplete_reason(data: ByteSource, offset: int) -> str:
    """Why :func:`read_record` found no whole record at ``offset``, as a clause of a message."""
    if offset == len(data):
        return f"it ends at byte {offset} without an index"
    if offset + RECORD.size <= len(data):
        length = RECORD.unpack(data[offset : offset + RECORD.size])[3]
        if offset + RECORD.size + length + CHECKSUM.size <= len(data):
            return f"the record at byte {offset} of {len(data)} is damaged"
    return f"it is cut at byte {len(data)}, within the record that begins at byte {offset}"


def scan_records(data: ByteSource, offset: int = PREFIX.size) -> Iterator[Record]:
    """Every record from byte ``offset`` on, up to the first truncated or damaged one."""
    while (record := read_record(data, offset)) is not None:
        yield record
        offset = record.end

# SPDX-License-Identifier: Apache-2.0
"""Records: the frame of everything in a stream file (docs/bitstream.md, section Records).

A file is the magic, the version, and records one after another. A record that is cut or damaged ends what can be read;
everything before it stands.
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
    """Readers skip the types they do not know."""

    INIT = 1
    KEY = 2
    DELTA = 3
    INDEX = 4


@dataclass(frozen=True)
class Record:
    """One record: its type, payload, and where its first byte is in the file."""

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


def packed(kind: RecordType, payload: bytes) -> bytes:
    """A record as bytes: header, payload, CRC-32 of both.

    Raises:
        StreamError: the payload is longer than a record can say.
    """
    if len(payload) > MAX_RECORD_BYTES:
        raise StreamError(f"A record of {len(payload)} bytes is too long; the format holds {MAX_RECORD_BYTES}.")
    head = RECORD.pack(kind, 0, 0, len(payload))
    return head + payload + CHECKSUM.pack(zlib.crc32(payload, zlib.crc32(head)))


def check_prefix(data: ByteSource, name: str) -> None:
    """Refuse what is not a stream of this major version.

    Raises:
        StreamError: with what was found and what to do.
    """
    if not prefix().startswith(bytes(data[: len(MAGIC)])):
        raise StreamError(f"{name} is not a structgstream file: its first bytes are not the format's signature.")
    if len(data) < PREFIX.size:
        raise StreamError(f"{name} is cut at byte {len(data)}, before anything that can be shown.")
    _, major, minor = PREFIX.unpack(data[: PREFIX.size])
    if major != MAJOR:
        newer, older = (
            "Install a newer structgstream.",
            "Reconstruct it again, or install the structgstream that wrote it.",
        )
        advice = newer if major > MAJOR else older
        raise StreamError(f"{name} has format version {major}.{minor}; this program reads {MAJOR}.x. {advice}")


def read_head(data: ByteSource, offset: int) -> tuple[int, int] | None:
    """Type and payload length that the record at ``offset`` states, when it is long enough to hold them."""
    if offset + RECORD.size + CHECKSUM.size > len(data):
        return None
    kind, _, _, length = RECORD.unpack(data[offset : offset + RECORD.size])
    return None if offset + RECORD.size + length + CHECKSUM.size > len(data) else (kind, length)


def read_record(data: ByteSource, offset: int) -> Record | None:
    """The whole, undamaged record at ``offset``, or None. Nothing is allocated before its length is known to fit."""
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
    """Where the index record begins that a stream ends with; None while the stream is still being written, or is cut.

    Only the footer and the head of the index are looked at, which is what a server that follows a file can afford.
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
    """What is at ``offset``, where :func:`read_record` found no whole record."""
    if offset == len(data):
        return f"it ends at byte {offset} without an index"
    if offset + RECORD.size <= len(data):
        length = RECORD.unpack(data[offset : offset + RECORD.size])[3]
        if offset + RECORD.size + length + CHECKSUM.size <= len(data):
            return f"the record at byte {offset} of {len(data)} is damaged"
    return f"it is cut at byte {len(data)}, within the record that begins at byte {offset}"


def scan_records(data: ByteSource, offset: int = PREFIX.size) -> Iterator[Record]:
    """Every record from byte ``offset`` on, up to the first that is cut or damaged."""
    while (record := read_record(data, offset)) is not None:
        yield record
        offset = record.end

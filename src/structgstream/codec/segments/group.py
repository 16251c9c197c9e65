# SPDX-License-Identifier: Apache-2.0
"""The group of frames that is being written: its parts, and the segment that they become."""

from collections.abc import Sequence

from structgstream.codec.container.packet_head import FRAME
from structgstream.codec.container.records import RecordType, read_record
from structgstream.codec.packet_kind import PacketKind
from structgstream.codec.segments.manifest import PartEntry, SegmentEntry, part_name, segment_name, sha256_of
from structgstream.errors import StreamError

_KINDS = {RecordType.KEY: PacketKind.KEY, RecordType.DELTA: PacketKind.DELTA}


def part_of(record: bytes) -> PartEntry:
    """The entry of a packet's record.

    Raises:
        StreamError: it is no whole record of a packet.
    """
    found = read_record(record, 0)
    if found is None or found.type not in _KINDS or len(found.payload) < FRAME.size:
        raise StreamError(f"{len(record)} bytes are no whole record of a packet.")
    frame, pts_seconds = FRAME.unpack_from(found.payload)
    sha256 = sha256_of(record)
    kind = _KINDS[RecordType(found.type)]
    return PartEntry(part_name(frame, sha256), frame, found.period, kind, pts_seconds, len(record), sha256)


def segment_of(parts: Sequence[PartEntry], data: bytes, *, segment: int) -> SegmentEntry:
    """The entry of the segment that consists of these parts, whose bytes are ``data``."""
    sha256 = sha256_of(data)
    return SegmentEntry(
        segment=segment,
        file=segment_name(segment, sha256),
        period=parts[0].period,
        first_frame=parts[0].frame,
        frames=len(parts),
        pts_seconds=(parts[0].pts_seconds, parts[-1].pts_seconds),
        bytes=len(data),
        key_bytes=parts[0].bytes,
        frame_bytes=tuple(part.bytes for part in parts),
        sha256=sha256,
    )


def records_of(entry: SegmentEntry, data: bytes) -> list[bytes]:
    """The records of each frame of a segment."""
    records, start = [], 0
    for size in entry.frame_bytes:
        records.append(data[start : start + size])
        start += size
    return records

# SPDX-License-Identifier: Apache-2.0
"""Segment files, which contain the frames of one group: streams whose first frame may be other than 0.

::

    prefix | init record | note | key or delta record ... | index record | footer

Prefix and init record are the header's bytes. The note is a record of type :data:`NOTE`, which readers of streams skip;
it identifies what the segment was fitted from. An incomplete segment has the name ``SEGMENT.partial``.
"""

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from structgstream.atomic_files import GrowingFile, name_finished, name_unfinished, partial_path
from structgstream.codec.container.byte_source import FileBytes, check_room, free_bytes
from structgstream.codec.container.records import (
    FRAME,
    INDEX_ENTRY,
    PACKET_KINDS,
    PREFIX,
    RECORD_TYPES,
    Period,
    Record,
    RecordType,
    check_prefix,
    incomplete_reason,
    pack_index,
    packed,
    read_record,
)
from structgstream.codec.packets import Packet, PacketKind, StreamHeader, parse_packet, unpack_header
from structgstream.codec.reader import PacketInfo
from structgstream.codec.scene_coder import SceneDecoder
from structgstream.errors import ConfigError, StreamError
from structgstream.groups.base import GroupBase
from structgstream.scene.scene import Scene

NOTE = 64
FORMAT, VERSION = "structgstream-group", 1


@dataclass(frozen=True)
class SegmentIdentity:
    """Everything that determines the bytes of a segment, except the machine."""

    header: str  # SHA-256 of header and frame 0 (base.GroupBase.sha256), including the configuration
    capture: str  # fingerprint of the capture
    track: str  # SHA-256 of the track's start at the first frame; empty for the group of frame 0
    options: Mapping[str, object]  # options of the group, as plain JSON values
    first: int  # the first frame
    end: int  # the frame after the last one

    @property
    def sha256(self) -> str:
        """SHA-256 of all fields."""
        return hashlib.sha256(json.dumps(asdict(self), sort_keys=True).encode()).hexdigest()

    def record(self) -> bytes:
        """The note of a segment."""
        text = {"format": FORMAT, "version": VERSION, "sha256": self.sha256, **asdict(self)}
        return packed(NOTE, json.dumps(text, sort_keys=True).encode())


@dataclass(frozen=True)
class Segment:
    """The complete records of a segment file, up to the first that is missing or damaged."""

    name: str  # name of the file, for messages
    data: bytes  # of the file
    identity: SegmentIdentity  # what the segment was fitted from
    init: bytes  # bytes of prefix and init record
    entries: list[tuple[int, int, int]]  # frame, type and offset of each packet
    end: int  # offset after the last complete packet
    complete: bool  # whether every frame is present, index and footer are valid, and nothing follows
    reason: str | None  # why the segment is not complete; None if it is

    @property
    def header(self) -> StreamHeader:
        """Content of the init record."""
        return unpack_header(verified_record(self.init, PREFIX.size).payload)

    def record(self, number: int) -> bytes:
        """The record of the segment's packet ``number``, framing included."""
        start = self.entries[number][2]
        stop = self.entries[number + 1][2] if number + 1 < len(self.entries) else self.end
        return self.data[start:stop]

    def records(self) -> Iterator[bytes]:
        """The records of all its packets."""
        return map(self.record, range(len(self.entries)))


class NoSegmentError(StreamError):
    """The file is a stream, but not a segment of one."""


def open_segment(path: Path) -> Segment:
    """Reads the segment file ``path`` whole; every byte is verified. Raises StreamError if the file is not a segment
    (NoSegmentError if it is a stream), or is damaged before its first packet."""
    with FileBytes(path) as file:
        data, name = file[:], str(path)
    check_prefix(data, name)
    init = read_record(data, PREFIX.size)
    note = None if init is None else read_record(data, init.end)
    if init is None or note is None or init.type != RecordType.INIT:
        raise StreamError(f"{name} is damaged before its first frame: {incomplete_reason(data, PREFIX.size)}.")
    if note.type != NOTE:
        raise NoSegmentError(f"{name} is a stream, not a segment of one; expected what structgstream fit-group writes.")
    identity = _identity(note, name)
    entries: list[tuple[int, int, int]] = []
    end = note.end
    for frame in range(identity.first, identity.end):
        record = read_record(data, end)
        if record is None or record.type not in PACKET_KINDS or len(record.payload) < FRAME.size:
            break
        if FRAME.unpack_from(record.payload)[0] != frame:
            break
        entries.append((frame, record.type, record.offset))
        end = record.end
    frames, reason = identity.end - identity.first, None
    complete = len(entries) == frames and data[end:] == pack_index(entries, end)
    if not complete:
        cut = "its index is damaged" if len(entries) == frames else incomplete_reason(data, end)
        reason = f"it has {len(entries)} of {frames} frames; {cut}"
    return Segment(name, data, identity, data[: init.end], entries, end, complete, reason)


def _identity(note: Record, name: str) -> SegmentIdentity:
    try:
        text = json.loads(note.payload)
        if not isinstance(text, dict):
            raise ValueError("it is no object")
        if (text.pop("format"), text.pop("version")) != (FORMAT, VERSION):
            raise ValueError("another format or version")
        stated = text.pop("sha256")
        found = SegmentIdentity(**text)
        if found.sha256 != stated:
            raise ValueError("a note that contradicts itself")
        if not (isinstance(found.first, int) and isinstance(found.end, int) and 0 <= found.first < found.end):
            raise ValueError(f"frames {found.first} to before {found.end}")
        return found
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise StreamError(f"The note of the segment {name} does not follow the format ({error}).") from error


class SegmentSink:
    """Appends the packets of a group to the existing part; the file is renamed after the last one. Raises StorageError
    if it cannot be written, or another process writes it."""

    def __init__(self, path: Path, base: GroupBase, identity: SegmentIdentity, found: Segment | None) -> None:
        self._identity = identity
        self._file = GrowingFile(path, keep=0 if found is None else found.end)
        self._entries = [] if found is None else [*found.entries]
        self._largest = 0
        if found is None:
            self._file.append(base.init + identity.record())
            if identity.first == 0:
                self._entries.append((0, int(RecordType.KEY), self._file.size))
                self._file.append(base.first)

    def open(self, header: StreamHeader) -> int:
        """Does nothing and returns 0: the file begins with the header already."""
        return 0

    def begin(self, header: StreamHeader) -> int:
        raise AssertionError("groups share one header")

    def write(self, packet: Packet) -> int:
        """Appends one packet; returns its size in bytes. Raises StorageError if it cannot be written, or the disk is
        nearly full; earlier packets are not affected."""
        kind, partial, frames = RECORD_TYPES[packet.kind], self._file.partial, len(self._entries)
        record = packed(kind, packet.payload)
        self._largest = max(self._largest, len(record))
        closing = (frames + 2) * INDEX_ENTRY.size
        check_room(free_bytes(partial), largest=self._largest, closing=closing, where=str(partial), frames=frames)
        at = self._file.size
        size = self._file.append(record)
        self._entries.append((packet.index, int(kind), at))
        return size

    def close(self) -> None:
        """Completes the segment after its last frame; otherwise it can be resumed later. A second call does nothing."""
        if len(self._entries) == self._identity.end - self._identity.first:
            self._file.append(pack_index(self._entries, self._file.size))
            self._entries = []
            self._file.finish()
        self._file.close()


@dataclass(frozen=True)
class GroupSoFar:
    """What a session resumes from: frame 0 and the packets of the group that exist.

    Its length is the index of the next frame, as if the frames before the group existed.
    """

    base: GroupBase
    first: int  # the group's first frame
    records: Sequence[bytes]  # records of the group's packets, framing included

    @property
    def header(self) -> StreamHeader:
        """Header of the stream."""
        return self.base.header

    def header_of(self, index: int) -> StreamHeader:
        """Header of the stream, which has a single period."""
        return self.base.header

    def period(self, index: int) -> Period:
        """The only period."""
        return Period(0, 0, PREFIX.size, len(self.base.init) - PREFIX.size)

    @property
    def packets(self) -> list[PacketInfo]:
        """Facts of the group's packets."""
        return [
            PacketInfo(packet.kind, packet.index, packet.pts_seconds, 0, len(record), packet.field_bytes)
            for packet, record in zip(map(packet_of, self.records), self.records, strict=True)
        ]

    @property
    def complete(self) -> bool:
        """Always False: a complete segment is not resumed."""
        return False

    def __len__(self) -> int:
        return self.first + len(self.records)

    def group(self, index: int) -> Iterator[Packet]:
        """The packets that frame ``index`` needs; frame 0 for indices before the group."""
        if index < self.first:
            yield self.base.packet
            return
        needed = [packet_of(self.records[index - self.first])]
        while needed[-1].kind is not PacketKind.KEY:
            needed.append(packet_of(self.records[index - self.first - len(needed)]))
        yield from reversed(needed)

    def scene(self, index: int) -> Scene:
        """The decoded frame ``index``, or frame 0 for those before the group."""
        decoder, scene = SceneDecoder(self.header), self.base.scene()
        for packet in self.group(index):
            scene = decoder.decode(packet)
        return scene


def verified_record(data: bytes, offset: int = 0) -> Record:
    """The record at ``offset``, which was verified before."""
    found = read_record(data, offset)
    assert found is not None, "verified before"
    return found


def packet_of(record: bytes) -> Packet:
    """The packet of a verified record. Raises StreamError if it does not follow the format."""
    found = verified_record(record)
    return parse_packet(found.payload, PACKET_KINDS[found.type])


def resume_segment(path: Path, base: GroupBase, identity: SegmentIdentity) -> Segment | None:
    """The existing part of a segment: the finished file, or the longest complete part of an unfinished one.

    A damaged finished file becomes an unfinished one. An unfinished file with all frames is renamed, because a run may
    have been killed just before it did so. A file that is damaged before its first packet is ignored.

    Raises:
        ConfigError: the existing file was fitted from something else, or is a stream.
        StorageError: the file cannot be renamed, or another process writes it.
    """
    if path.exists():
        found = _matching(path, base, identity)
        if found is not None and found.complete:
            return found
        name_unfinished(path)
    found = _matching(partial_path(path), base, identity) if partial_path(path).exists() else None
    if found is not None and found.complete:
        name_finished(path)
    return found


def _matching(path: Path, base: GroupBase, identity: SegmentIdentity) -> Segment | None:
    if not path.stat().st_size:
        return None
    try:
        found = open_segment(path)
    except NoSegmentError:
        raise ConfigError(
            f"{path} is a stream, not a segment of one; choose another name, or replace it with --overwrite."
        ) from None
    except StreamError:
        return None
    if found.identity == identity:
        return found if found.init == base.init and (identity.first or found.entries) else None
    names = [name for name in vars(identity) if getattr(found.identity, name) != getattr(identity, name)]
    raise ConfigError(
        f"{path} is a group of another {' and '.join(names)}; give the same header, track, capture and options, "
        "another name, or --overwrite."
    )

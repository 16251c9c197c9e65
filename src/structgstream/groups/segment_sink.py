# SPDX-License-Identifier: Apache-2.0
"""Writes a segment, and provides the existing part of a segment that is resumed."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from structgstream.atomic_files import partial_path
from structgstream.codec.container.byte_source import check_room, free_bytes
from structgstream.codec.container.records import (
    INDEX_ENTRY,
    PREFIX,
    Period,
    RecordType,
    pack_index,
    packed,
    read_record,
)
from structgstream.codec.decoder import SceneDecoder
from structgstream.codec.packets import Packet, PacketKind, StreamHeader, parse_packet
from structgstream.codec.reader import PacketInfo
from structgstream.errors import ConfigError, StreamError
from structgstream.groups.base import GroupBase
from structgstream.groups.growing_file import GrowingFile, name_finished
from structgstream.groups.segment_file import Segment, SegmentIdentity, open_segment
from structgstream.scene.scene import Scene

_TYPES = {PacketKind.KEY: RecordType.KEY, PacketKind.DELTA: RecordType.DELTA}
_KINDS = {record: kind for kind, record in _TYPES.items()}


class SegmentSink:
    """Appends the packets of a group; the file is renamed after the last one.

    Args:
        path: path of the finished segment.
        base: the part of the stream that all groups share.
        identity: identity of the segment.
        found: existing part that is retained; None for a new segment.

    Raises:
        StorageError: it cannot be written, or another process writes it.
    """

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
        """Not supported: groups share one header.

        Raises:
            ConfigError: always.
        """
        raise ConfigError("A group cannot begin another period; leave out --period.")

    def write(self, packet: Packet) -> int:
        """Appends one packet; returns its size in bytes.

        Raises:
            StorageError: it cannot be written, or the disk is nearly full; earlier packets are not affected.
        """
        record = packed(_TYPES[packet.kind], packet.payload)
        self._largest = max(self._largest, len(record))
        closing = (len(self._entries) + 2) * INDEX_ENTRY.size
        where, frames = str(self._file.partial), len(self._entries)
        free = free_bytes(self._file.partial)
        check_room(free, largest=self._largest, closing=closing, where=where, frames=frames)
        at = self._file.size
        size = self._file.append(record)
        self._entries.append((packet.index, int(_TYPES[packet.kind]), at))
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

    Args:
        base: the part of the stream that all groups share.
        first: the group's first frame.
        records: records of the group's packets, framing included.
    """

    base: GroupBase
    first: int
    records: Sequence[bytes]

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
            for packet, record in zip(map(_packet, self.records), self.records, strict=True)
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
        number = index - self.first
        first = number
        while _packet(self.records[first]).kind is not PacketKind.KEY:
            first -= 1
        for record in self.records[first : number + 1]:
            yield _packet(record)

    def scene(self, index: int) -> Scene:
        """The decoded frame ``index``, or frame 0 for those before the group."""
        decoder, scene = SceneDecoder(self.header), self.base.scene()
        for packet in self.group(index):
            scene = decoder.decode(packet)
        return scene


def _packet(record: bytes) -> Packet:
    found = read_record(record, 0)
    assert found is not None, "verified before"
    return parse_packet(found.payload, _KINDS[RecordType(found.type)])


def resume_segment(path: Path, base: GroupBase, identity: SegmentIdentity) -> Segment | None:
    """The existing part of a segment: the finished file, or the longest complete part of an unfinished one.

    A damaged finished file becomes an unfinished one. An unfinished file with all frames is renamed, because a run may
    have been killed just before it did so. A file that is damaged before its first packet is ignored.

    Raises:
        ConfigError: the existing file was fitted from something else.
        StorageError: a file cannot be renamed, or another process writes it.
    """
    if path.exists():
        found = _matching(path, base, identity)
        if found is not None and found.complete:
            return found
        if found is not None:
            found.close()
        path.replace(partial_path(path))
    found = _matching(partial_path(path), base, identity) if partial_path(path).exists() else None
    if found is None or not found.complete:
        return found
    found.close()
    name_finished(path)
    return open_segment(path)


def _matching(path: Path, base: GroupBase, identity: SegmentIdentity) -> Segment | None:
    if not path.stat().st_size:
        return None
    try:
        found = open_segment(path)
    except StreamError:
        return None
    if found.identity == identity and found.init == base.init and (identity.first or found.entries):
        return found
    found.close()
    if found.identity == identity:
        return None
    names = [name for name in vars(identity) if getattr(found.identity, name) != getattr(identity, name)]
    raise ConfigError(
        f"{path} is a group of another {' and '.join(names)}; give the same header, track, capture and options, "
        "another name, or --overwrite."
    )

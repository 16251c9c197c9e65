# SPDX-License-Identifier: Apache-2.0
"""Segment files, which contain the frames of one group: streams whose first frame may be other than 0.

::

    prefix | init record | note | key or delta record ... | index record | footer

Prefix and init record are the header's bytes. The note is a record of type :data:`NOTE`, which readers of streams skip;
it identifies what the segment was fitted from. An incomplete segment has the name ``SEGMENT.partial``.
"""

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from structgstream.codec.container.byte_source import ByteSource, FileBytes
from structgstream.codec.container.records import (
    FRAME,
    PREFIX,
    Record,
    RecordType,
    check_prefix,
    incomplete_reason,
    pack_index,
    packed,
    read_record,
)
from structgstream.errors import StreamError

NOTE = 64
FORMAT, VERSION = "structgstream-group", 1
_PACKETS = (RecordType.KEY, RecordType.DELTA)


@dataclass(frozen=True)
class SegmentIdentity:
    """Everything that determines the bytes of a segment, except the machine.

    Args:
        header: SHA-256 of header and frame 0 (``base.GroupBase.sha256``), including the configuration.
        capture: fingerprint of the capture.
        track: SHA-256 of the track's start at the first frame; empty for the group of frame 0.
        options: options of the group, as plain JSON values.
        first: the first frame.
        end: the frame after the last one.
    """

    header: str
    capture: str
    track: str
    options: Mapping[str, object]
    first: int
    end: int

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
    """The complete records of a segment file, up to the first that is missing or damaged.

    Args:
        name: name of the file, for messages.
        data: bytes of the file.
        identity: what the segment was fitted from.
        init: bytes of prefix and init record.
        entries: frame, type and offset of each packet.
        end: offset after the last complete packet.
        complete: whether every frame is present, index and footer are valid, and nothing follows.
        reason: why the segment is not complete; None if it is.
    """

    name: str
    data: ByteSource
    identity: SegmentIdentity
    init: bytes
    entries: list[tuple[int, int, int]]
    end: int
    complete: bool
    reason: str | None

    @property
    def next_frame(self) -> int:
        """The first frame that is missing."""
        return self.identity.first + len(self.entries)

    def record(self, number: int) -> bytes:
        """The record of the segment's packet ``number``, framing included."""
        start = self.entries[number][2]
        stop = self.entries[number + 1][2] if number + 1 < len(self.entries) else self.end
        return bytes(self.data[start:stop])

    def close(self) -> None:
        """Closes the file."""
        if isinstance(self.data, FileBytes):
            self.data.close()


def open_segment(path: Path) -> Segment:
    """Opens the segment file ``path``; every byte is verified.

    Raises:
        StreamError: the file is not a segment, or is damaged before its first packet.
    """
    data = FileBytes(path)
    try:
        return _read(data, str(path))
    except BaseException:
        data.close()
        raise


@dataclass(frozen=True)
class SegmentFacts:
    """Result of :func:`inspect_segment`.

    Args:
        first: first frame of the group.
        end: the frame after its last one.
        frames: number of complete frames, from the first on.
        complete: whether the segment is finished and undamaged.
        identity: SHA-256 of what the segment was fitted from.
        reason: why the segment is not complete; None if it is.
    """

    first: int
    end: int
    frames: int
    complete: bool
    identity: str
    reason: str | None = None


def inspect_segment(path: Path) -> SegmentFacts:
    """Verifies a segment file.

    Raises:
        StreamError: see :func:`open_segment`.
    """
    found = open_segment(path)
    found.close()
    identity = found.identity
    return SegmentFacts(identity.first, identity.end, len(found.entries), found.complete, identity.sha256, found.reason)


def _read(data: ByteSource, name: str) -> Segment:
    check_prefix(data, name)
    init = read_record(data, PREFIX.size)
    note = None if init is None else read_record(data, init.end)
    if init is None or note is None or init.type != RecordType.INIT:
        raise StreamError(f"{name} is damaged before its first frame: {incomplete_reason(data, PREFIX.size)}.")
    if note.type != NOTE:
        raise StreamError(f"{name} is a stream, not a segment of one; expected what structgstream fit-group writes.")
    identity = _identity(note, name)
    entries: list[tuple[int, int, int]] = []
    end = note.end
    for record in _packets(data, note.end, identity):
        entries.append((identity.first + len(entries), record.type, record.offset))
        end = record.end
    frames = identity.end - identity.first
    closing = pack_index(entries, end)
    complete = len(entries) == frames and bytes(data[end:]) == closing
    reason = None
    if not complete:
        cut = "its index is damaged" if len(entries) == frames else incomplete_reason(data, end)
        reason = f"it has {len(entries)} of {frames} frames; {cut}"
    return Segment(name, data, identity, bytes(data[: init.end]), entries, end, complete, reason)


def _packets(data: ByteSource, offset: int, identity: SegmentIdentity) -> Iterator[Record]:
    """The complete packets from byte ``offset`` on, up to the first that is not the group's next frame."""
    for frame in range(identity.first, identity.end):
        record = read_record(data, offset)
        if record is None or record.type not in _PACKETS or len(record.payload) < FRAME.size:
            return
        if FRAME.unpack_from(record.payload)[0] != frame:
            return
        yield record
        offset = record.end


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

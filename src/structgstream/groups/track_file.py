# SPDX-License-Identifier: Apache-2.0
"""Track files, the result of a tracking pass: positions of primitives in each frame at which a group may begin.

::

    signature, version | head record | start record ... | end record

Records are framed as those of a stream (``codec/container/records``), each with a CRC-32. The file grows under the name
``TRACK.partial`` and is renamed when the pass is done. A group can be fitted as soon as its start record is written.
"""

import json
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from structgstream.atomic_files import GrowingFile, atomic_write, partial_path
from structgstream.codec.container.byte_source import ByteSource, FileBytes
from structgstream.codec.container.records import RECORD, packed, read_head, read_record
from structgstream.errors import ConfigError, StreamError

SIGNATURE = b"\x89SGT\r\n\x1a\n"
MAJOR, MINOR = 1, 0
PREFIX = struct.Struct("<8sHH")
START = struct.Struct("<III")  # frame, number of primitives, number of changed shares
SHARE_UNIT = 1 / 65535


class TrackRecord(IntEnum):
    """Types of records."""

    HEAD = 1
    START = 2
    END = 3


@dataclass(frozen=True)
class TrackStart:
    """Displacements of primitives (Note [Primitives]) in a frame, in quantization steps of positions.

    Primitives that are not listed have not moved since frame 0.
    """

    frame: int  # the frame
    primitives: NDArray[np.int32]  # [r] int32, ascending
    displacements: NDArray[np.int32]  # [r, 3] int32, since frame 0
    velocities: NDArray[np.int32]  # [r, 3] int32, since the frame before
    # [n] float32, share of changed pixels in each frame after the last start, up to this one
    changed: NDArray[np.float32]

    def packed(self) -> bytes:
        """The payload of a start record."""
        shares = np.clip(np.round(self.changed / SHARE_UNIT), 0, 65535).astype("<u2")
        gaps = np.diff(self.primitives, prepend=np.int32(0)).astype(np.int32)
        table = np.column_stack([gaps, self.displacements, self.velocities]).astype("<i4")
        # Bytes of equal significance are stored together, because the upper bytes of small numbers are equal.
        planes = np.ascontiguousarray(table.T).view(np.uint8).reshape(-1, 4).T.tobytes()
        return START.pack(self.frame, len(self.primitives), len(shares)) + zlib.compress(shares.tobytes() + planes, 9)

    @classmethod
    def unpacked(cls, payload: bytes) -> "TrackStart":
        """The content of a start record. Raises ValueError if it violates the format."""
        frame, rows, shares = START.unpack_from(payload)
        size = 2 * shares + 28 * rows
        unpacker = zlib.decompressobj()
        data = unpacker.decompress(payload[START.size :], size)
        if len(data) != size or not unpacker.eof:
            raise ValueError("a start record of another length than it states")
        changed = np.frombuffer(data, "<u2", shares).astype(np.float32) * np.float32(SHARE_UNIT)
        planes = np.frombuffer(data, np.uint8, 28 * rows, 2 * shares).reshape(4, -1)
        table = np.ascontiguousarray(planes.T).view("<i4").reshape(7, rows).astype(np.int32)
        primitives = np.cumsum(table[0], dtype=np.int32)
        return cls(frame, primitives, table[1:4].T.copy(), table[4:7].T.copy(), changed)


@dataclass(frozen=True)
class TrackHead:
    """What a track was made from."""

    header: str  # SHA-256 of the header and frame 0 (base.GroupBase.sha256)
    capture: str  # fingerprint of the capture
    step: float  # quantization step of positions, in units of the scene
    primitives: int  # number of primitives of frame 0
    every: int  # frames from one possible start to the next
    config: Mapping[str, Any]  # configuration of the pass, as plain JSON values


class TrackFile:
    """Reads a track; of an unfinished pass, its complete records.

    Attributes:
        head: what the track was made from.
        starts: the frames at which groups may begin, frame 0 not included.
        groups: ``(first frame, end)`` of the groups that the pass chose; None if it is not finished.

    Raises:
        StreamError: the file is not a track, or has another version.
    """

    def __init__(self, data: ByteSource, name: str) -> None:
        self._data, self._name, self._offsets = data, name, dict[int, int]()
        self.groups: list[tuple[int, int]] | None = None
        if len(data) < PREFIX.size or not bytes(data[: PREFIX.size]).startswith(SIGNATURE):
            raise StreamError(f"{name} is no track; make one with: structgstream track CAPTURE --init HEADER -o {name}")
        if (major := PREFIX.unpack(data[: PREFIX.size])[1]) != MAJOR:
            raise StreamError(f"{name} is a track of version {major}; this program reads {MAJOR}. Make it again.")
        head = read_record(data, PREFIX.size)
        if head is None or head.type != TrackRecord.HEAD:
            raise StreamError(f"The beginning of the track {name} is damaged; make it again.")
        try:
            self.head = TrackHead(**json.loads(head.payload))
        except (TypeError, ValueError) as error:
            raise StreamError(f"The head of the track {name} does not follow the format ({error}).") from error
        self._scan(head.end)

    @property
    def starts(self) -> list[int]:
        """The frames at which groups may begin, ascending."""
        return [*self._offsets]

    def _scan(self, offset: int) -> None:
        # Record heads only: the checksum of a start is verified when it is read.
        while (found := read_head(self._data, offset)) is not None:
            if found.type != TrackRecord.START or found.length < START.size:
                break
            frame = START.unpack(self._data[offset + RECORD.size : offset + RECORD.size + START.size])[0]
            self._offsets[frame] = offset
            offset += found.bytes
        last = read_record(self._data, offset)
        if last is not None and last.type == TrackRecord.END:
            try:
                self.groups = [(int(first), int(end)) for first, end in json.loads(last.payload)["groups"]]
            except (ValueError, KeyError, TypeError, RecursionError) as error:
                raise StreamError(f"The end of the track {self._name} does not follow the format ({error}).") from error

    def start(self, frame: int) -> TrackStart:
        """The start record of ``frame``. Raises StreamError if the pass has stored no start at this frame, or it is
        damaged."""
        if frame not in self._offsets:
            near = ", ".join(map(str, self.starts[:8])) or "none"
            raise StreamError(
                f"The track {self._name} has no start at frame {frame}; it has {near}"
                f"{', ...' if len(self._offsets) > 8 else ''}. Begin groups there, or track again with other --groups."
            )
        record = read_record(self._data, self._offsets[frame])
        try:
            if record is not None:
                return TrackStart.unpacked(record.payload)
        except (ValueError, struct.error, zlib.error):
            pass
        raise StreamError(f"The start at frame {frame} in the track {self._name} is damaged; track again.")

    def whole_starts(self) -> Iterator[tuple[TrackStart, int]]:
        """The starts in order up to the first damaged one, each with the offset after it."""
        for frame in self.starts:
            record = read_record(self._data, self._offsets[frame])
            if record is None:
                return
            yield self.start(frame), record.end


def open_track(path: Path) -> TrackFile:
    """Opens the track at ``path``, or its unfinished file while the pass runs. Raises StreamError if there is no file,
    or it is not a track."""
    partial = partial_path(path)
    found = partial if not path.exists() and partial.exists() else path
    return TrackFile(FileBytes(found), str(found))


def track_bytes(head: TrackHead, *starts: TrackStart) -> bytes:
    """An unfinished track with these starts."""
    records = [packed(TrackRecord.HEAD, json.dumps(vars(head), sort_keys=True).encode())]
    records += [packed(TrackRecord.START, start.packed()) for start in starts]
    return PREFIX.pack(SIGNATURE, MAJOR, MINOR) + b"".join(records)


class TrackWriter:
    """Writes the track ``path``. Raises StorageError if it cannot be written."""

    def __init__(self, path: Path, head: TrackHead, *, keep: int = 0) -> None:
        self._file = GrowingFile(path, keep=keep)
        if not keep:
            self._file.append(track_bytes(head))

    def write(self, start: TrackStart) -> None:
        """Appends a start."""
        self._file.append(packed(TrackRecord.START, start.packed()))

    def finish(self, frames: int, groups: Sequence[tuple[int, int]]) -> None:
        """Completes the track and renames it."""
        facts = {"frames": frames, "groups": [list(group) for group in groups]}
        self._file.append(packed(TrackRecord.END, json.dumps(facts).encode()))
        self._file.finish()

    def close(self) -> None:
        """Closes the file, which can be resumed later."""
        self._file.close()


Groups = Sequence[tuple[int, int]]
"""First frame and end of each group, in order."""


def groups_path(track: Path) -> Path:
    """The path of a track's list."""
    return track.with_name(f"{track.name}.groups")


def write_groups(track: Path, groups: Groups) -> None:
    """Writes the list of a track atomically. Raises StorageError if it cannot be written."""
    lines = "".join(f"{first}:{end}\n" for first, end in groups)
    atomic_write(groups_path(track), lines.encode(), new_folder=True)


def read_groups(track: Path) -> Groups | None:
    """The groups of a track of a whole capture; None while the pass has not chosen them. Raises StreamError if the list
    has gaps or does not follow the format."""
    path = groups_path(track)
    try:
        text = path.read_text(errors="replace")
    except OSError:
        return None
    if not text.endswith("\n"):
        return None
    try:
        groups = [(int(first), int(end)) for first, _, end in (line.partition(":") for line in text.split())]
    except ValueError:
        raise StreamError(f"{path} has no groups, 'first:end' a line.") from None
    borders = [0, *(end for _, end in groups)]
    if not groups or [first for first, _ in groups] != borders[:-1] or borders != sorted(set(borders)):
        raise StreamError(f"The groups in {path} do not follow each other from frame 0 on.")
    return groups


def check_length(length: int, *, key_interval: int) -> None:
    """Check that groups of ``length`` frames begin at frames that are key packets anyway. Raises ConfigError if they do
    not, so every group would cost an additional key packet."""
    if length < 1 or length % key_interval:
        near = max(1, round(length / key_interval)) * key_interval
        raise ConfigError(
            f"Groups of {length} frames cost a key packet each, because the stream has one every {key_interval} frames "
            f"(key_interval_seconds); take {near}, or another multiple, or add --allow-unaligned to pay for them."
        )


def equal_groups(frames: int, length: int) -> list[tuple[int, int]]:
    """Groups ``(first frame, end)`` of ``length`` frames; the last may be shorter, or one frame longer.

    A single frame at the end joins the group before, because a seam blend needs a group's second frame
    (``seam_blend.py``).
    """
    firsts = [*range(0, frames, length)]
    if length > 1 and len(firsts) > 1 and frames - firsts[-1] == 1:
        firsts.pop()
    return [*zip(firsts, [*firsts[1:], frames], strict=True)]


def quiet_groups(frames: int, length: int, changed: Mapping[int, float]) -> list[tuple[int, int]]:
    """Groups of about ``length`` frames that begin at frames with little motion.

    Every group has at least half and at most one and a half times ``length`` frames; the last may be shorter, but has
    at least two. ``changed`` is the share of changed pixels by frame at which a group may begin. Among all such
    divisions, this one minimizes the sum over its borders of the share there plus the mean of all shares.
    """
    least, most = (length + 1) // 2, length + length // 2
    mean = sum(changed.values()) / max(len(changed), 1)
    # The cost of a border is its change plus the mean of all changes, so that about frames / length borders are chosen.
    best: dict[int, tuple[float, int]] = {0: (0.0, -1)}
    for frame in sorted(changed):
        found = [(cost, first) for first, (cost, _) in best.items() if least <= frame - first <= most]
        if found and frame < frames:
            cost, first = min(found)
            best[frame] = (cost + changed[frame] + mean, first)
    ends = [
        (cost, first)
        for first, (cost, _) in best.items()
        if frames - first <= most and (frames - first > 1 or not first)
    ]
    if not ends:
        return equal_groups(frames, length)
    first, end, groups = min(ends)[1], frames, []
    while first >= 0:
        groups.append((first, end))
        first, end = best[first][1], first
    return groups[::-1]

# SPDX-License-Identifier: Apache-2.0
"""The manifest of a segments folder as values (docs/segments.md)."""

import hashlib
from dataclasses import dataclass
from typing import Protocol

from structgstream.codec.packet_kind import PacketKind

FORMAT = "structgstream-segments"
VERSION = 1
MANIFEST = "manifest.json"
"""The name of the only file that changes."""

PAGE_SEGMENTS = 32
"""Segments of a history page, and pages of a page of pages."""
PAGE_FRAMES = 960
"""A page is written early when its segments have this many frames, which bounds the manifest for long groups too."""
LISTED_SEGMENTS = 8
"""The newest segments are always listed in the manifest itself."""


class StoredFile(Protocol):
    """What every entry states of its file."""

    @property
    def file(self) -> str: ...

    @property
    def bytes(self) -> int: ...

    @property
    def sha256(self) -> str: ...


@dataclass(frozen=True)
class Edge:
    """The newest frame.

    Args:
        frame: its number.
        pts_seconds: its presentation time.
        captured_unix_seconds: when it was filmed; None if that is not known.
        published_unix_seconds: when it was written, by the writer's clock.
    """

    frame: int
    pts_seconds: float
    captured_unix_seconds: float | None
    published_unix_seconds: float


@dataclass(frozen=True)
class Window:
    """What is still there: everything from ``first_frame`` on. ``seconds`` is None if nothing is ever removed."""

    first_frame: int
    first_segment: int
    seconds: float | None


@dataclass(frozen=True)
class PeriodEntry:
    """The init record of a period, and where the period begins."""

    period: int
    file: str
    bytes: int
    sha256: str
    first_frame: int
    first_segment: int


@dataclass(frozen=True)
class SegmentEntry:
    """A whole group of frames.

    Args:
        segment: its number.
        file: its name.
        period: number of the period whose init record it needs.
        first_frame: number of its key frame.
        frames: how many.
        pts_seconds: presentation times of its first and last frame.
        bytes: its length.
        key_bytes: length of its prefix with which its first frame can be shown.
        frame_bytes: length of each frame's records, in order.
        sha256: of its content.
    """

    segment: int
    file: str
    period: int
    first_frame: int
    frames: int
    pts_seconds: tuple[float, float]
    bytes: int
    key_bytes: int
    frame_bytes: tuple[int, ...]
    sha256: str


@dataclass(frozen=True)
class HistoryEntry:
    """A page of older segments.

    Args:
        file: its name.
        level: 0 if the page lists segments, otherwise it lists pages of the level below.
        first_segment: number of the first segment of the page.
        segments: number of segments in all.
        first_frame: number of the first frame.
        frames: number of frames in all.
        pts_seconds: presentation times of the first and the last frame.
        bytes: length of the page.
        sha256: of the page.
    """

    file: str
    level: int
    first_segment: int
    segments: int
    first_frame: int
    frames: int
    pts_seconds: tuple[float, float]
    bytes: int
    sha256: str


@dataclass(frozen=True)
class PartEntry:
    """One frame of the group that is being written."""

    file: str
    frame: int
    period: int
    kind: PacketKind
    pts_seconds: float
    bytes: int
    sha256: str


@dataclass(frozen=True)
class Manifest:
    """A stream at one moment: pages, then segments, then parts follow each other without gaps.

    Args:
        sequence: rises by one with every rewriting.
        live: False once the run has finished or was stopped.
        fps: of the media.
        name: of the capture.
        target_latency_seconds: how far a player should keep behind the edge.
        frame_seconds: mean wall-clock seconds from frame to frame of late; None before the second.
        edge: the newest frame.
        window: what is still there.
        periods: of what is listed, the last one is the running one.
        history: pages, oldest first.
        segments: the newest ones.
        parts: of the group being written, none when ``live`` is False.
    """

    sequence: int
    live: bool
    fps: float
    name: str
    target_latency_seconds: float
    frame_seconds: float | None
    edge: Edge
    window: Window
    periods: tuple[PeriodEntry, ...]
    history: tuple[HistoryEntry, ...]
    segments: tuple[SegmentEntry, ...]
    parts: tuple[PartEntry, ...]

    @property
    def files(self) -> tuple[str, ...]:
        """The names of the files that the manifest itself names."""
        return tuple(entry.file for part in (self.periods, self.history, self.segments, self.parts) for entry in part)


def sha256_of(data: bytes) -> str:
    """The SHA-256 of a file's content, as hex digits."""
    return hashlib.sha256(data).hexdigest()


def init_name(period: int, sha256: str) -> str:
    """The name of a period's init record."""
    return f"init-{period:04d}-{sha256[:16]}.sgs"


def part_name(frame: int, sha256: str) -> str:
    """The name of a frame of the group being written."""
    return f"part-{frame:08d}-{sha256[:16]}.sgs"


def segment_name(segment: int, sha256: str) -> str:
    """The name of a segment."""
    return f"segment-{segment:08d}-{sha256[:16]}.sgs"


def history_name(first_segment: int, sha256: str) -> str:
    """The name of a page whose first segment has this number."""
    return f"history-{first_segment:08d}-{sha256[:16]}.json"

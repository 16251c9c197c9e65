# SPDX-License-Identifier: Apache-2.0
"""The manifest of a segments folder: values, JSON, and the checks of what a host sends (docs/segments.md).

Equal values are equal bytes: keys are sorted, there is no white space, and numbers come back exactly.

The host may be hostile, so every value is checked for its type and bounds before it is used. The player's reader
(viewer/packages/player/src/source/checks.ts) follows the same rules, which docs/segments.md states: `12.0` and `1.2e1`
are whole numbers, what is not RFC 8259 is refused also where nobody asks for it, and so is a byte order mark.
"""

import hashlib
import json
import re
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any, Literal, NoReturn

from structgstream.codec.container.records import PacketKind
from structgstream.errors import StreamError

MOST = 1e15
"""The largest number where nothing else is stated; whole numbers up to it are exact in a double."""

_FILE = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9._-]{0,127}", re.ASCII)
_SHA256 = re.compile(r"[0-9a-f]{64}", re.ASCII)
_HALF_CHARACTER = re.compile("[\ud800-\udfff]")


class Fields:
    """The fields of a JSON object; ``where`` names it in messages. Fields that nobody asks for are ignored.

    Raises:
        StreamError: every method, when the field is missing, of another type or beyond its bounds.
    """

    def __init__(self, value: object, where: str) -> None:
        self._where = where
        if not isinstance(value, dict):
            raise StreamError(f"{where} is {_shown(value)}; expected an object.")
        self._value: dict[str, Any] = value

    def whole(self, name: str, *, least: int = 0, most: int = 2**32 - 1) -> int:
        """A whole number."""
        return self._whole(name, self._get(name), least, most)

    def wholes(self, name: str, *, count: int, least: int = 0, most: int = 2**32 - 1) -> tuple[int, ...]:
        """A list of ``count`` whole numbers."""
        values = self._checked(name, lambda value: _is_list(value, count), f"a list of {count} whole numbers")
        return tuple(self._whole(name, value, least, most) for value in values)

    def number(self, name: str, *, least: float = -MOST) -> float:
        """A finite number."""
        return self._number(name, self._get(name), least)

    def optional(self, name: str, *, least: float = -MOST) -> float | None:
        """A finite number, or None for null."""
        return None if self._get(name) is None else self.number(name, least=least)

    def pair(self, name: str) -> tuple[float, float]:
        """Two finite numbers that do not fall."""
        values = self._checked(name, lambda value: _is_list(value, 2), "two numbers")
        first, last = (self._number(name, value, -MOST) for value in values)
        if first > last:
            self._refuse(name, values, "two numbers that do not fall")
        return first, last

    def text(self, name: str, *, most: int = 1000) -> str:
        """A text of at most ``most`` characters, which can be printed: JSON may hold halves of characters."""

        def fits(value: object) -> bool:
            return isinstance(value, str) and len(value) <= most and not _HALF_CHARACTER.search(value)

        return self._checked(name, fits, f"a text of at most {most} characters")

    def flag(self, name: str) -> bool:
        """True or false."""
        return self._checked(name, lambda value: isinstance(value, bool), "true or false")

    def file(self, name: str = "file") -> str:
        """The plain name of a file in the manifest's folder: no folder, no scheme, no leading dot."""
        return self._matched(name, _FILE, "the plain name of a file beside it (letters, digits, '.', '_' and '-')")

    def sha256(self, name: str = "sha256") -> str:
        """64 hex digits."""
        return self._matched(name, _SHA256, "64 hex digits")

    def items(self, name: str, *, most: int) -> "list[Fields]":
        """A list of at most ``most`` objects."""
        expected = f"a list of at most {most} objects"
        values = self._checked(name, lambda value: isinstance(value, list) and len(value) <= most, expected)
        return [Fields(value, f"{self._where}, {name}[{i}]") for i, value in enumerate(values)]

    def fields(self, name: str) -> "Fields":
        """An object."""
        return Fields(self._get(name), f"{self._where}, {name}")

    def refuse(self, reason: str) -> NoReturn:
        """Raise an error about this object."""
        raise StreamError(f"{self._where} {reason}.")

    def _get(self, name: str) -> Any:
        if name not in self._value:
            raise StreamError(f"{self._where} has no {name!r}.")
        return self._value[name]

    def _checked(self, name: str, fits: Callable[[Any], bool], expected: str) -> Any:
        if not fits(value := self._get(name)):
            self._refuse(name, value, expected)
        return value

    def _matched(self, name: str, pattern: re.Pattern[str], expected: str) -> str:
        return self._checked(name, lambda value: isinstance(value, str) and bool(pattern.fullmatch(value)), expected)

    def _whole(self, name: str, value: Any, least: int, most: int) -> int:
        if not _is_number(value) or not least <= value <= most or value != int(value):
            self._refuse(name, value, f"a whole number from {least} to {most}")
        return int(value)

    def _number(self, name: str, value: Any, least: float) -> float:
        if not _is_number(value) or not least <= value <= MOST:
            self._refuse(name, value, f"a number from {least:g} to {MOST:g}")
        return float(value)

    def _refuse(self, name: str, value: object, expected: str) -> NoReturn:
        raise StreamError(f"{self._where} has {name!r} {_shown(value)}; expected {expected}.")


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _is_list(value: object, count: int) -> bool:
    return isinstance(value, list) and len(value) == count


def parse_object(data: bytes, where: str, *, max_bytes: int) -> Fields:
    """The JSON object in ``data``. Raises StreamError if it is longer than ``max_bytes``, or not a JSON object."""
    if len(data) > max_bytes:
        raise StreamError(f"{where} has {len(data)} bytes; expected at most {max_bytes}.")
    try:
        value = json.loads(data.decode(), parse_int=_number, parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        raise StreamError(f"{where} is not JSON ({error}).") from None
    return Fields(value, where)


def parse_document(data: bytes, name: str, *, max_bytes: int, what: str, format: str, version: int) -> Fields:
    """The JSON object in ``data``, ``what`` of a format and version. Raises StreamError if it is of another format or
    version, or as :func:`parse_object`."""
    top = parse_object(data, name, max_bytes=max_bytes)
    if (found := top.text("format")) != format:
        raise StreamError(f"{name} is no {what}: its format is {found!r}; expected {format!r}.")
    if (found := top.whole("version")) != version:
        raise StreamError(f"{name} has version {found}; this program reads {version}. Install a newer structgstream.")
    return top


def _number(text: str) -> int | float:
    """Python refuses to convert very many digits, which are a number nevertheless."""
    return int(text) if len(text) < 20 else float(text)


def _no_constant(name: str) -> NoReturn:
    raise ValueError(f"it holds {name}")


def _shown(value: object) -> str:
    try:
        text = json.dumps(value)
    except (ValueError, RecursionError):
        text = type(value).__name__
    return text if len(text) <= 60 else f"{text[:60]}..."


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


@dataclass(frozen=True)
class Edge:
    """The newest frame."""

    frame: int  # its number
    pts_seconds: float  # its presentation time
    captured_unix_seconds: float | None  # when it was filmed; None if that is not known
    published_unix_seconds: float  # when it was written, by the writer's clock


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
    """A whole group of frames."""

    segment: int  # its number
    file: str  # its name
    period: int  # number of the period whose init record it needs
    first_frame: int  # number of its key frame
    frames: int  # how many
    pts_seconds: tuple[float, float]  # presentation times of its first and last frame
    bytes: int  # its length
    key_bytes: int  # length of its prefix with which its first frame can be shown
    frame_bytes: tuple[int, ...]  # length of each frame's records, in order
    sha256: str  # of its content
    segments = 1  # as of a page

    @property
    def first_segment(self) -> int:
        """Its own number, as of a page."""
        return self.segment


@dataclass(frozen=True)
class HistoryEntry:
    """A page of older segments."""

    file: str  # its name
    level: int  # 0 if the page lists segments, otherwise it lists pages of the level below
    first_segment: int  # number of the first segment of the page
    segments: int  # number of segments in all
    first_frame: int  # number of the first frame
    frames: int  # number of frames in all
    pts_seconds: tuple[float, float]  # presentation times of the first and the last frame
    bytes: int  # length of the page
    sha256: str  # of the page


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


StoredFile = PeriodEntry | SegmentEntry | HistoryEntry | PartEntry


@dataclass(frozen=True)
class Manifest:
    """A stream at one moment: pages, then segments, then parts follow each other without gaps."""

    sequence: int  # rises by one with every rewriting
    live: bool  # False once the run has finished or was stopped
    fps: float  # of the media
    name: str  # of the capture
    target_latency_seconds: float  # how far a player should keep behind the edge
    frame_seconds: float | None  # mean wall-clock seconds from frame to frame of late; None before the second
    edge: Edge  # the newest frame
    window: Window  # what is still there
    periods: tuple[PeriodEntry, ...]  # of what is listed, the last one is the running one
    history: tuple[HistoryEntry, ...]  # pages, oldest first
    segments: tuple[SegmentEntry, ...]  # the newest ones
    parts: tuple[PartEntry, ...]  # of the group being written, none when live is False

    @property
    def files(self) -> tuple[str, ...]:
        """The names of the files that the manifest itself names."""
        return tuple(entry.file for part in (self.periods, self.history, self.segments, self.parts) for entry in part)


def sha256_of(data: bytes) -> str:
    """The SHA-256 of a file's content, as hex digits."""
    return hashlib.sha256(data).hexdigest()


def file_name(kind: Literal["init", "part", "segment", "history"], number: int, sha256: str) -> str:
    """The name of a file: of the init record of a period, of a frame of the group being written, of a segment, or of a
    page whose first segment has this number."""
    digits, suffix = 4 if kind == "init" else 8, "json" if kind == "history" else "sgs"
    return f"{kind}-{number:0{digits}d}-{sha256[:16]}.{suffix}"


MAX_MANIFEST_BYTES = 4 * 2**20
MAX_PAGE_BYTES = 4 * 2**20
MAX_ENTRIES = 4096
MAX_GROUP_FRAMES = 65_536
MAX_SEGMENT_BYTES = 2**40
MAX_LEVEL = 8
MIN_FPS = 1e-9


def manifest_to_json(manifest: Manifest) -> bytes:
    """The content of ``manifest.json``."""
    parts = [{**asdict(part), "kind": part.kind.name.lower()} for part in manifest.parts]
    return _dumped({**asdict(manifest), "parts": parts, "format": FORMAT, "version": VERSION})


def manifest_from_json(data: bytes, *, name: str) -> Manifest:
    """The manifest in ``data``; ``name`` is for messages. Raises StreamError if it is no manifest, of a newer version,
    or contradicts itself or the format's bounds."""
    what = "manifest of segments"
    top = parse_document(data, name, max_bytes=MAX_MANIFEST_BYTES, what=what, format=FORMAT, version=VERSION)
    edge, window = top.fields("edge"), top.fields("window")
    manifest = Manifest(
        sequence=top.whole("sequence", most=2**53 - 1),
        live=top.flag("live"),
        fps=top.number("fps", least=MIN_FPS),
        name=top.text("name"),
        target_latency_seconds=top.number("target_latency_seconds", least=0.0),
        frame_seconds=top.optional("frame_seconds", least=0.0),
        edge=Edge(
            frame=edge.whole("frame"),
            pts_seconds=edge.number("pts_seconds"),
            captured_unix_seconds=edge.optional("captured_unix_seconds"),
            published_unix_seconds=edge.number("published_unix_seconds"),
        ),
        window=Window(window.whole("first_frame"), window.whole("first_segment"), window.optional("seconds")),
        periods=tuple(_period(entry) for entry in top.items("periods", most=MAX_ENTRIES)),
        history=tuple(_page(entry) for entry in top.items("history", most=MAX_ENTRIES)),
        segments=tuple(_segment(entry) for entry in top.items("segments", most=MAX_ENTRIES)),
        parts=tuple(_part(entry) for entry in top.items("parts", most=MAX_GROUP_FRAMES)),
    )
    _check(manifest, name)
    return manifest


def page_to_json(entries: Sequence[SegmentEntry] | Sequence[HistoryEntry]) -> bytes:
    """The content of a history page: of segments, or of pages of the level below."""
    key = "segments" if isinstance(entries[0], SegmentEntry) else "history"
    return _dumped({"format": FORMAT, "version": VERSION, key: [asdict(entry) for entry in entries]})


def page_from_json(data: bytes, entry: HistoryEntry) -> tuple[SegmentEntry, ...] | tuple[HistoryEntry, ...]:
    """The entries of the page that ``entry`` names: pages if its level is above 0, otherwise segments. Raises
    StreamError if it is no page, or not what ``entry`` announces."""
    top = parse_object(data, entry.file, max_bytes=MAX_PAGE_BYTES)
    if top.text("format") != FORMAT or top.whole("version") != VERSION:
        top.refuse(f"is no history page of {FORMAT} {VERSION}")
    found: tuple[SegmentEntry, ...] | tuple[HistoryEntry, ...]
    if entry.level:
        found = tuple(_page(one) for one in top.items("history", most=MAX_ENTRIES))
        if any(page.level != entry.level - 1 for page in found):
            top.refuse(f"lists pages of other levels than {entry.level - 1}")
    else:
        found = tuple(_segment(one) for one in top.items("segments", most=MAX_ENTRIES))
    _check_run(found, entry.first_segment, entry.first_frame, entry.file)
    counts = sum(one.segments for one in found), sum(one.frames for one in found)
    if counts != (entry.segments, entry.frames):
        top.refuse(f"has {counts[0]} segments of {counts[1]} frames; expected {entry.segments} of {entry.frames}")
    return found


def _dumped(value: dict[str, Any]) -> bytes:
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False).encode() + b"\n"


def _period(fields: Fields) -> PeriodEntry:
    return PeriodEntry(
        period=fields.whole("period"),
        file=fields.file(),
        bytes=fields.whole("bytes", least=1, most=MAX_SEGMENT_BYTES),
        sha256=fields.sha256(),
        first_frame=fields.whole("first_frame"),
        first_segment=fields.whole("first_segment"),
    )


def _page(fields: Fields) -> HistoryEntry:
    return HistoryEntry(
        file=fields.file(),
        level=fields.whole("level", most=MAX_LEVEL),
        first_segment=fields.whole("first_segment"),
        segments=fields.whole("segments", least=1),
        first_frame=fields.whole("first_frame"),
        frames=fields.whole("frames", least=1),
        pts_seconds=fields.pair("pts_seconds"),
        bytes=fields.whole("bytes", least=1, most=MAX_PAGE_BYTES),
        sha256=fields.sha256(),
    )


def _segment(fields: Fields) -> SegmentEntry:
    frames = fields.whole("frames", least=1, most=MAX_GROUP_FRAMES)
    entry = SegmentEntry(
        segment=fields.whole("segment"),
        file=fields.file(),
        period=fields.whole("period"),
        first_frame=fields.whole("first_frame"),
        frames=frames,
        pts_seconds=fields.pair("pts_seconds"),
        bytes=fields.whole("bytes", least=1, most=MAX_SEGMENT_BYTES),
        key_bytes=fields.whole("key_bytes", least=1, most=2**33),
        frame_bytes=fields.wholes("frame_bytes", count=frames, least=1, most=2**33),
        sha256=fields.sha256(),
    )
    if sum(entry.frame_bytes) != entry.bytes or entry.key_bytes != entry.frame_bytes[0]:
        fields.refuse("states lengths of frames that are not those of the segment")
    return entry


def _part(fields: Fields) -> PartEntry:
    kinds = {kind.name.lower(): kind for kind in PacketKind}
    if (kind := fields.text("kind", most=20)) not in kinds:
        fields.refuse(f"has 'kind' {kind!r}; expected {' or '.join(kinds)}")
    return PartEntry(
        file=fields.file(),
        frame=fields.whole("frame"),
        period=fields.whole("period"),
        kind=kinds[kind],
        pts_seconds=fields.number("pts_seconds"),
        bytes=fields.whole("bytes", least=1, most=2**33),
        sha256=fields.sha256(),
    )


def _check(manifest: Manifest, name: str) -> None:
    """Check that what a manifest lists follows each other, and ends at its edge."""
    pages, window = manifest.history, manifest.window
    segment, frame = _check_run(pages, 0, 0, name)
    segment, frame = _check_run(manifest.segments, segment, frame, name)
    for part in manifest.parts:
        if part.frame != frame:
            raise StreamError(f"{name} has a part of frame {part.frame} where one of frame {frame} belongs.")
        frame += 1
    if manifest.edge.frame != frame - 1:
        raise StreamError(f"{name} lists frames 0 to {frame - 1}, and its edge is frame {manifest.edge.frame}.")
    if manifest.parts and not manifest.live:
        raise StreamError(f"{name} has parts although its run has ended.")
    if manifest.parts and manifest.parts[0].kind is not PacketKind.KEY:
        raise StreamError(f"{name} has parts that do not begin with a key frame.")
    if window.first_frame >= frame or window.first_segment > segment:
        raise StreamError(f"{name} has a window that begins after its edge.")
    periods = manifest.periods
    if not periods or periods[0].first_frame > window.first_frame:
        raise StreamError(f"{name} names no init record of the first frame of its window.")
    for before, after in pairwise(periods):
        if after.period != before.period + 1 or after.first_frame <= before.first_frame:
            raise StreamError(f"{name} does not list its periods in their order.")
    known = {period.period for period in periods}
    used = {entry.period for entry in (*manifest.segments, *manifest.parts) if not _gone(entry, window)}
    if not used <= known:
        raise StreamError(f"{name} names no init record of period {min(used - known)}.")


def _gone(entry: SegmentEntry | PartEntry, window: Window) -> bool:
    return isinstance(entry, SegmentEntry) and entry.segment < window.first_segment


def _check_run(
    entries: Sequence[SegmentEntry] | Sequence[HistoryEntry], segment: int, frame: int, name: str
) -> tuple[int, int]:
    """Check that entries follow each other from this segment and frame on; returns those after the last."""
    for entry in entries:
        if (entry.first_frame, entry.first_segment) != (frame, segment):
            raise StreamError(
                f"{name} lists {entry.file}, which begins with frame {entry.first_frame} and segment "
                f"{entry.first_segment}, where frame {frame} and segment {segment} belong."
            )
        segment += entry.segments
        frame += entry.frames
    return segment, frame

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
from functools import cache, partial
from itertools import pairwise
from typing import Annotated, Any, Literal, NoReturn, TypeVar, get_type_hints

from structgstream.codec.container.records import PacketKind
from structgstream.errors import StreamError

Value = TypeVar("Value")
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


MAX_MANIFEST_BYTES = 4 * 2**20
MAX_PAGE_BYTES = 4 * 2**20
MAX_ENTRIES = 4096
MAX_GROUP_FRAMES = 65_536
MAX_SEGMENT_BYTES = 2**40
MAX_FRAME_BYTES = 2**33
MAX_LEVEL = 8
MIN_FPS = 1e-9

# A field of the values below is annotated with its reader, which also checks its bounds.
Whole = Annotated[int, Fields.whole]
Count = Annotated[int, partial(Fields.whole, least=1)]
FrameCount = Annotated[int, partial(Fields.whole, least=1, most=MAX_GROUP_FRAMES)]
FrameBytes = Annotated[int, partial(Fields.whole, least=1, most=MAX_FRAME_BYTES)]
SegmentBytes = Annotated[int, partial(Fields.whole, least=1, most=MAX_SEGMENT_BYTES)]
PageBytes = Annotated[int, partial(Fields.whole, least=1, most=MAX_PAGE_BYTES)]
Number = Annotated[float, Fields.number]
Pair = Annotated[tuple[float, float], Fields.pair]
NumberOrNone = Annotated[float | None, Fields.optional]
FileName = Annotated[str, Fields.file]
Sha256 = Annotated[str, Fields.sha256]


@cache
def _readers(kind: type) -> dict[str, Callable[[Fields, str], Any]]:
    return {name: hint.__metadata__[0] for name, hint in get_type_hints(kind, include_extras=True).items()}


def _read(kind: type[Value], fields: Fields) -> Value:
    """The value with the fields of an object."""
    return kind(**{name: reader(fields, name) for name, reader in _readers(kind).items()})


def _object(fields: Fields, name: str, *, kind: type[Value]) -> Value:
    return _read(kind, fields.fields(name))


def _list(fields: Fields, name: str, *, kind: type[Value], most: int = MAX_ENTRIES) -> tuple[Value, ...]:
    return tuple(_read(kind, one) for one in fields.items(name, most=most))


def _frame_bytes(fields: Fields, name: str) -> tuple[int, ...]:
    count = fields.whole("frames", least=1, most=MAX_GROUP_FRAMES)
    found = fields.wholes(name, count=count, least=1, most=MAX_FRAME_BYTES)
    if sum(found) != fields.whole("bytes", most=MAX_SEGMENT_BYTES) or found[0] != fields.whole(
        "key_bytes", most=MAX_FRAME_BYTES
    ):
        fields.refuse("states lengths of frames that are not those of the segment")
    return found


def _kind(fields: Fields, name: str) -> PacketKind:
    kinds = {kind.name.lower(): kind for kind in PacketKind}
    if (kind := fields.text(name, most=20)) not in kinds:
        fields.refuse(f"has {name!r} {kind!r}; expected {' or '.join(kinds)}")
    return kinds[kind]


@dataclass(frozen=True)
class Edge:
    """The newest frame."""

    frame: Whole  # its number
    pts_seconds: Number  # its presentation time
    captured_unix_seconds: NumberOrNone  # when it was filmed; None if that is not known
    published_unix_seconds: Number  # when it was written, by the writer's clock


@dataclass(frozen=True)
class Window:
    """What is still there: everything from ``first_frame`` on. ``seconds`` is None if nothing is ever removed."""

    first_frame: Whole
    first_segment: Whole
    seconds: NumberOrNone


@dataclass(frozen=True)
class PeriodEntry:
    """The init record of a period, and where the period begins."""

    period: Whole
    file: FileName
    bytes: SegmentBytes
    sha256: Sha256
    first_frame: Whole
    first_segment: Whole


@dataclass(frozen=True)
class SegmentEntry:
    """A whole group of frames."""

    segment: Whole  # its number
    file: FileName  # its name
    period: Whole  # number of the period whose init record it needs
    first_frame: Whole  # number of its key frame
    frames: FrameCount  # how many
    pts_seconds: Pair  # presentation times of its first and last frame
    bytes: SegmentBytes  # its length
    key_bytes: FrameBytes  # length of its prefix with which its first frame can be shown
    frame_bytes: Annotated[tuple[int, ...], _frame_bytes]  # length of each frame's records, in order
    sha256: Sha256  # of its content
    segments = 1  # as of a page

    @property
    def first_segment(self) -> int:
        """Its own number, as of a page."""
        return self.segment


@dataclass(frozen=True)
class HistoryEntry:
    """A page of older segments."""

    file: FileName  # its name
    # 0 if the page lists segments, otherwise it lists pages of the level below
    level: Annotated[int, partial(Fields.whole, most=MAX_LEVEL)]
    first_segment: Whole  # number of the first segment of the page
    segments: Count  # number of segments in all
    first_frame: Whole  # number of the first frame
    frames: Count  # number of frames in all
    pts_seconds: Pair  # presentation times of the first and the last frame
    bytes: PageBytes  # length of the page
    sha256: Sha256  # of the page


@dataclass(frozen=True)
class PartEntry:
    """One frame of the group that is being written."""

    file: FileName
    frame: Whole
    period: Whole
    kind: Annotated[PacketKind, _kind]
    pts_seconds: Number
    bytes: FrameBytes
    sha256: Sha256


StoredFile = PeriodEntry | SegmentEntry | HistoryEntry | PartEntry


@dataclass(frozen=True)
class Manifest:
    """A stream at one moment: pages, then segments, then parts follow each other without gaps."""

    sequence: Annotated[int, partial(Fields.whole, most=2**53 - 1)]  # rises by one with every rewriting
    live: Annotated[bool, Fields.flag]  # False once the run has finished or was stopped
    fps: Annotated[float, partial(Fields.number, least=MIN_FPS)]  # of the media
    name: Annotated[str, Fields.text]  # of the capture
    # how far a player should keep behind the edge
    target_latency_seconds: Annotated[float, partial(Fields.number, least=0.0)]
    # mean wall-clock seconds from frame to frame of late; None before the second
    frame_seconds: Annotated[float | None, partial(Fields.optional, least=0.0)]
    edge: Annotated[Edge, partial(_object, kind=Edge)]  # the newest frame
    window: Annotated[Window, partial(_object, kind=Window)]  # what is still there
    # of what is listed, the last one is the running one
    periods: Annotated[tuple[PeriodEntry, ...], partial(_list, kind=PeriodEntry)]
    history: Annotated[tuple[HistoryEntry, ...], partial(_list, kind=HistoryEntry)]  # pages, oldest first
    segments: Annotated[tuple[SegmentEntry, ...], partial(_list, kind=SegmentEntry)]  # the newest ones
    # of the group being written, none when live is False
    parts: Annotated[tuple[PartEntry, ...], partial(_list, kind=PartEntry, most=MAX_GROUP_FRAMES)]


def sha256_of(data: bytes) -> str:
    """The SHA-256 of a file's content, as hex digits."""
    return hashlib.sha256(data).hexdigest()


def file_name(kind: Literal["init", "part", "segment", "history"], number: int, sha256: str) -> str:
    """The name of a file: of the init record of a period, of a frame of the group being written, of a segment, or of a
    page whose first segment has this number."""
    digits, suffix = 4 if kind == "init" else 8, "json" if kind == "history" else "sgs"
    return f"{kind}-{number:0{digits}d}-{sha256[:16]}.{suffix}"


def manifest_to_json(manifest: Manifest) -> bytes:
    """The content of ``manifest.json``."""
    parts = [{**asdict(part), "kind": part.kind.name.lower()} for part in manifest.parts]
    return _dumped({**asdict(manifest), "parts": parts, "format": FORMAT, "version": VERSION})


def manifest_from_json(data: bytes, *, name: str) -> Manifest:
    """The manifest in ``data``; ``name`` is for messages. Raises StreamError if it is no manifest, of a newer version,
    or contradicts itself or the format's bounds."""
    what = "manifest of segments"
    top = parse_document(data, name, max_bytes=MAX_MANIFEST_BYTES, what=what, format=FORMAT, version=VERSION)
    manifest = _read(Manifest, top)
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
        found = _list(top, "history", kind=HistoryEntry)
        if any(page.level != entry.level - 1 for page in found):
            top.refuse(f"lists pages of other levels than {entry.level - 1}")
    else:
        found = _list(top, "segments", kind=SegmentEntry)
    _check_run(found, entry.first_segment, entry.first_frame, entry.file)
    counts = sum(one.segments for one in found), sum(one.frames for one in found)
    if counts != (entry.segments, entry.frames):
        top.refuse(f"has {counts[0]} segments of {counts[1]} frames; expected {entry.segments} of {entry.frames}")
    return found


def _dumped(value: dict[str, Any]) -> bytes:
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False).encode() + b"\n"


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

# SPDX-License-Identifier: Apache-2.0
"""Writes a stream as segments (docs/segments.md).

Note [Order of writing]
~~~~~~~~~~~~~~~~~~~~~~~
A manifest is written after all files that it names, and a file is removed only some time after the last manifest that
named it. So a reader that has any manifest of late finds all its files. A frame is written when its part is durable:
should the manifest that names it never be written, resuming finds the part by its number (``recovery``).
"""

import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

from structgstream.codec.container.disk_room import check_room
from structgstream.codec.container.records import RecordType, packed
from structgstream.codec.packets import Packet, PacketKind, StreamHeader
from structgstream.codec.segments.group import part_of
from structgstream.codec.segments.history import segments_from
from structgstream.codec.segments.manifest import (
    MANIFEST,
    Edge,
    Manifest,
    PeriodEntry,
    SegmentEntry,
    Window,
)
from structgstream.codec.segments.manifest_json import manifest_from_json, manifest_to_json
from structgstream.codec.segments.next_manifest import (
    Draft,
    empty_manifest,
    init_file,
    period_entry,
    periods_in,
    reopened,
    running_period,
    with_frame,
    with_period,
    with_segment,
    without_empty_period,
)
from structgstream.codec.segments.recovery import stale_files
from structgstream.codec.segments.store import Store
from structgstream.errors import StorageError, StreamError

_TYPES = {PacketKind.KEY: RecordType.KEY, PacketKind.DELTA: RecordType.DELTA}
_RECENT_FRAMES = 8
_LATENCY_FRAMES = 3.0
_ENTRY_BYTES = 1024


@dataclass(frozen=True)
class SegmentsOptions:
    """What of a stream is kept.

    Args:
        window_seconds: media seconds before the edge that viewers can go back; None for everything.
        grace_seconds: seconds that a file stays after the last manifest that named it.
    """

    window_seconds: float | None = None
    grace_seconds: float = 120.0


def _unknown(frame: int) -> float | None:
    return None


@dataclass(frozen=True)
class Clocks:
    """Where times come from.

    Args:
        wall: seconds since 1970.
        elapsed: seconds that never jump.
        captured: when a frame was filmed, by its number, in seconds since 1970; None where that is not known.
    """

    wall: Callable[[], float] = time.time
    elapsed: Callable[[], float] = time.monotonic
    captured: Callable[[int], float | None] = _unknown


class SegmentsSink:
    """A sink of immutable segments and a manifest. Every packet is durable in the store when ``write`` returns.

    Args:
        store: where the files go.
        overwrite: whether a stream that is there may be replaced.
        options: what is kept.
        clocks: where times come from.
        found: what is there already, to go on after it (``recovery.find``).
    """

    def __init__(
        self,
        store: Store,
        *,
        overwrite: bool = False,
        options: SegmentsOptions | None = None,
        clocks: Clocks | None = None,
        found: Draft | None = None,
    ) -> None:
        self._store = store
        self._overwrite = overwrite
        self._options = options or SegmentsOptions()
        self._clocks = clocks or Clocks()
        self._found = found
        self._draft: Draft | None = None
        self._present: list[SegmentEntry] = []  # segments in the window, if there is one
        self._kept: list[SegmentEntry] = []  # those that have left it and are needed to resume
        self._named: tuple[PeriodEntry, ...] = ()  # the last manifest's periods
        self._leaving: dict[str, float] = {}  # files that no manifest names, and since when; oldest first
        self._published: deque[float] = deque(maxlen=_RECENT_FRAMES + 1)
        self._header_bytes = self._largest = 0

    def open(self, header: StreamHeader) -> int:
        """Write the init record, or continue a stream, which already has one; returns the bytes written.

        Raises:
            StorageError: there is a stream already and it may not be overwritten, or nothing can be written.
        """
        if self._found is not None:
            self._continue(self._found)
            return 0
        there = self._store.names()
        if there and not self._overwrite:
            raise StorageError(
                f"{self._store.name} holds a stream; continue it with --resume, replace it with --overwrite, or choose "
                "another name."
            )
        sequence = self._remove(there)
        data = init_file(header, 0)
        period = period_entry(data, 0, first_frame=0, first_segment=0)
        self._put([(period.file, data)])
        self._header_bytes = len(data)
        self._draft = Draft(empty_manifest(header, period, sequence=sequence))
        return len(data)

    def begin(self, header: StreamHeader) -> int:
        """Begin another period with the next packet; its init record is written and named at once.

        Raises:
            StorageError: it cannot be written; earlier packets stay.
        """
        draft = with_period(self._opened(), header)
        size = draft.manifest.periods[-1].bytes
        self._header_bytes = max(self._header_bytes, size)
        self._check_room(draft, self._largest)
        self._publish(draft, [])
        return size

    def write(self, packet: Packet) -> int:
        """Write one packet; returns the bytes of its record.

        Raises:
            StorageError: it cannot be written; earlier packets stay.
        """
        draft = self._opened()
        assert packet.index == draft.manifest.edge.frame + 1, "frames have no gaps"
        period = draft.manifest.periods[-1]
        begins = packet.index == period.first_frame
        assert packet.kind is PacketKind.KEY or not begins, "a period begins with a key packet"
        record = packed(_TYPES[packet.kind], packet.payload, period=period.period)
        self._check_room(draft, len(record))
        part = part_of(record)
        self._put([(part.file, record)])
        leaving: list[str] = []
        if packet.kind is PacketKind.KEY:
            leaving = [one.file for one in draft.manifest.parts]
            draft = with_segment(draft)
        elif not draft.records:
            leaving = [draft.manifest.segments[-1].file]
            draft = reopened(draft, self._store)
        captured = self._clocks.captured(packet.index)
        edge = Edge(packet.index, packet.pts_seconds, captured, self._clocks.wall())
        self._published.append(edge.published_unix_seconds)
        self._publish(with_frame(draft, part, record, edge), leaving)
        return len(record)

    def close(self) -> None:
        """Finish the group as a segment and say in the manifest that the run has ended. A second call does nothing.

        Raises:
            StorageError: no room; all frames are safe.
        """
        draft, self._draft = self._draft, None
        if draft is None or draft.manifest.edge.frame < 0:
            return
        leaving = [part.file for part in draft.manifest.parts]
        draft = with_segment(draft)
        manifest = without_empty_period(draft.manifest)
        self._publish(replace(draft, manifest=replace(manifest, live=False)), leaving)
        self._draft = None

    def _opened(self) -> Draft:
        assert self._draft is not None, "open() comes before write()"
        return self._draft

    def _continue(self, found: Draft) -> None:
        """Write what a killed run did not come to, and take up the stream where it ends."""
        manifest, there = found.manifest, self._store.names()
        self._header_bytes = manifest.periods[-1].bytes
        self._largest = max(map(len, found.records), default=0)
        self._put(found.files)
        if self._options.window_seconds is not None:
            first, needed = manifest.window.first_segment, running_period(manifest).first_segment
            found_from = min(first, needed)
            there_are = segments_from(self._store, manifest.history, manifest.segments, first=found_from)
            entries = [entry for entry in there_are if entry.segment >= first or entry.segment == needed]
            self._present = [entry for entry in entries if entry.segment >= first]
            self._kept = [entry for entry in entries if entry.segment < first]
        now = self._clocks.elapsed()
        self._leaving = dict.fromkeys(sorted(stale_files(manifest, there)), now)
        self._publish(replace(found, manifest=replace(manifest, live=True)), [])

    def _remove(self, there: frozenset[str]) -> int:
        """Remove the stream that is to be replaced, its manifest first; returns its last sequence number."""
        sequence = 0
        if MANIFEST in there:
            with suppress(StreamError):  # It is being replaced, whatever it says.
                sequence = manifest_from_json(self._store.get(MANIFEST), name=MANIFEST).sequence
        for name in sorted(there, key=lambda name: (name != MANIFEST, not name.startswith("init-"), name)):
            self._store.delete(name)
        return sequence

    def _publish(self, draft: Draft, leaving: Iterable[str]) -> None:
        """Write the files of a draft, then its manifest; then remove what has not been named for long enough.

        Args:
            draft: what to write.
            leaving: files that this manifest is the first not to name.
        """
        self._put(draft.files)
        present = self._present_with(draft.manifest)
        gone = self._leaving_segments(draft.manifest, present)
        manifest = self._with_window(draft.manifest, present[:gone])
        self._put([(MANIFEST, manifest_to_json(manifest))])
        self._draft = Draft(manifest, draft.records)
        self._present = present[gone:]
        needed = running_period(manifest).first_segment  # Its first frame is needed to resume.
        left = [*self._kept, *present[:gone]]
        self._kept = [entry for entry in left if entry.segment == needed]
        ended = {period.file for period in self._named} - {period.file for period in manifest.periods}
        self._named = manifest.periods
        self._forget([*leaving, *sorted(ended), *(entry.file for entry in left if entry.segment != needed)])

    def _present_with(self, manifest: Manifest) -> list[SegmentEntry]:
        """The segments that are there, if there is a window, as of this manifest."""
        if self._options.window_seconds is None:
            return []
        first = manifest.segments[0].segment if manifest.segments else 0
        listed = [entry for entry in manifest.segments if entry.segment >= manifest.window.first_segment]
        return [*(entry for entry in self._present if entry.segment < first), *listed]

    def _leaving_segments(self, manifest: Manifest, present: Sequence[SegmentEntry]) -> int:
        """How many segments leave the window with this manifest."""
        if (seconds := self._options.window_seconds) is None:
            return 0
        start = manifest.edge.pts_seconds - seconds
        return next((i for i, entry in enumerate(present) if entry.pts_seconds[1] >= start), len(present))

    def _with_window(self, manifest: Manifest, left: Sequence[SegmentEntry]) -> Manifest:
        """The manifest with its next number, its window without the segments that ``left``, and the pace of late."""
        window = replace(manifest.window, seconds=self._options.window_seconds)
        if left:
            window = Window(left[-1].first_frame + left[-1].frames, left[-1].segment + 1, window.seconds)
        frame_seconds = None
        if len(self._published) > 1:
            frame_seconds = max(self._published[-1] - self._published[0], 0.0) / (len(self._published) - 1)
        return replace(
            manifest,
            sequence=manifest.sequence + 1,
            window=window,
            periods=periods_in(manifest.periods, window),
            frame_seconds=None if frame_seconds is None else round(frame_seconds, 4),
            target_latency_seconds=round(_LATENCY_FRAMES * max(frame_seconds or 0.0, 1.0 / manifest.fps), 3),
        )

    def _forget(self, leaving: Iterable[str]) -> None:
        """Remember that files are no longer named; remove those for which that has been so for long enough."""
        now = self._clocks.elapsed()
        self._leaving |= dict.fromkeys(leaving, now)
        late = now - self._options.grace_seconds
        for name in [name for name, since in self._leaving.items() if since <= late]:
            del self._leaving[name]
            with suppress(StorageError):  # It is found again when the stream is resumed.
                self._store.delete(name)

    def _check_room(self, draft: Draft, size: int) -> None:
        self._largest = max(self._largest, size)
        manifest = draft.manifest
        listed = 64 + len(manifest.segments) + len(manifest.history) + len(manifest.parts)
        check_room(
            self._store.free_bytes(),
            largest=self._largest,
            closing=self._header_bytes + sum(map(len, draft.records)) + _ENTRY_BYTES * listed,
            where=self._store.name,
            frames=manifest.edge.frame + 1,
        )

    def _put(self, files: Iterable[tuple[str, bytes]]) -> None:
        try:
            for name, data in files:
                self._store.put(name, data)
                # What a killed run had written too early may come again under the same name, and then stays.
                self._leaving.pop(name, None)
        except StorageError as error:
            frames = 0 if self._draft is None else self._draft.manifest.edge.frame + 1
            raise StorageError(
                f"{error} The {frames} frames before are safe in it; make room and continue with --resume."
            ) from error

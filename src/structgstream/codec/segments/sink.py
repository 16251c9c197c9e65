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
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, replace

from structgstream.codec.container.byte_source import check_room
from structgstream.codec.container.records import RECORD_TYPES, packed
from structgstream.codec.packets import Packet, PacketKind, StreamHeader, sound_record
from structgstream.codec.segments.manifest import MANIFEST, Edge, Manifest, SegmentEntry, Window, manifest_to_json
from structgstream.codec.segments.recovery import (
    Draft,
    empty_manifest,
    init_file,
    next_segment,
    part_of,
    period_entry,
    periods_in,
    reopened,
    running_period,
    stale_files,
    with_frame,
    with_period,
    with_segment,
    without_empty_period,
)
from structgstream.codec.segments.store import Store
from structgstream.codec.segments.stored_bytes import read_manifest, segments_from
from structgstream.errors import StorageError, StreamError


@dataclass(frozen=True)
class SegmentsOptions:
    """How long files of a stream stay."""

    window_seconds: float | None = None  # media seconds before the edge that viewers can go back; None for everything
    grace_seconds: float = 120.0  # seconds that a file stays after the last manifest that named it


class Retention:
    """Moves the window, and removes files that no manifest has named for the time of grace."""

    def __init__(self, store: Store, options: SegmentsOptions, elapsed: Callable[[], float]) -> None:
        self._store, self._options, self._elapsed = store, options, elapsed
        self._last: Manifest | None = None
        # With a window the segments in it, and that which resuming needs; without one those that the manifest lists.
        self._kept: list[SegmentEntry] = []
        self._leaving: dict[str, float] = {}  # files that no manifest names, and since when

    def take_up(self, manifest: Manifest) -> None:
        """Begins with a stream that is there, whose last manifest this is. Raises StreamError if a page of its history
        is missing or damaged."""
        stale = stale_files(manifest, self._store.names())
        listed: Iterable[SegmentEntry] = manifest.segments
        if self._options.window_seconds is not None:
            first = min(manifest.window.first_segment, running_period(manifest).first_segment)
            listed = segments_from(self._store, manifest.history, manifest.segments, first=first)
        self._last, self._kept = manifest, [entry for entry in listed if not _has_left(entry, manifest)]
        self._leaving = dict.fromkeys(sorted(stale), self._elapsed())

    def window(self, manifest: Manifest) -> Window:
        """The window of a manifest that is to be published."""
        window = replace(manifest.window, seconds=self._options.window_seconds)
        if window.seconds is None:
            return window
        start = manifest.edge.pts_seconds - window.seconds
        present = [entry for entry in self._segments(manifest) if entry.segment >= window.first_segment]
        if not (left := [entry for entry in present if entry.pts_seconds[1] < start]):
            return window
        return Window(left[-1].first_frame + left[-1].frames, left[-1].segment + 1, window.seconds)

    def published(self, manifest: Manifest) -> None:
        """Takes in that a manifest is there, and removes what has not been named for long enough."""
        segments, end = self._segments(manifest), next_segment(manifest)
        others = () if self._last is None else (*self._last.periods, *self._last.parts)
        named = {entry.file for entry in (*manifest.periods, *manifest.parts)}
        leaving = [entry.file for entry in others if entry.file not in named]
        leaving += [entry.file for entry in self._kept if entry.segment >= end]  # opened again
        leaving += [entry.file for entry in segments if _has_left(entry, manifest)]
        listed = manifest.segments if self._options.window_seconds is None else segments
        self._last, self._kept = manifest, [entry for entry in listed if not _has_left(entry, manifest)]
        now = self._elapsed()
        self._leaving |= dict.fromkeys(leaving, now)
        late = now - self._options.grace_seconds
        for name in [name for name, since in self._leaving.items() if since <= late]:
            del self._leaving[name]
            with suppress(StorageError):  # It is found again when the stream is resumed.
                self._store.delete(name)

    def written(self, name: str) -> None:
        """Takes in that a file was written: what a killed run had written too early may come again, and then stays."""
        self._leaving.pop(name, None)

    def _segments(self, manifest: Manifest) -> list[SegmentEntry]:
        """Those that were kept with the last manifest, except one that was opened again, and those that this adds."""
        first, end = 0 if self._last is None else next_segment(self._last), next_segment(manifest)
        kept = [entry for entry in self._kept if entry.segment < end]
        return [*kept, *(entry for entry in manifest.segments if entry.segment >= first)]


def _has_left(entry: SegmentEntry, manifest: Manifest) -> bool:
    """Whether a segment has left the manifest's window, and resuming does not need it."""
    return entry.segment < manifest.window.first_segment and entry.segment != running_period(manifest).first_segment


_RECENT_FRAMES = 8
_LATENCY_FRAMES = 3.0
_ENTRY_BYTES = 1024


@dataclass(frozen=True)
class Clocks:
    """Where times come from."""

    wall: Callable[[], float] = time.time  # seconds since 1970
    elapsed: Callable[[], float] = time.monotonic  # seconds that never jump
    # when a frame was filmed, by its number, in seconds since 1970; None where that is not known
    captured: Callable[[int], float | None] = lambda frame: None


class SegmentsSink:
    """A sink of immutable segments and a manifest, which goes on after what was ``found`` (``recovery.find``), or
    replaces it. Every packet is durable in the store when ``write`` returns."""

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
        self._clocks = clocks or Clocks()
        self._found = found
        self._draft: Draft | None = None
        self._retention = Retention(store, options or SegmentsOptions(), self._clocks.elapsed)
        self._published: deque[float] = deque(maxlen=_RECENT_FRAMES + 1)
        self._header_bytes = self._largest = 0

    def open(self, header: StreamHeader) -> int:
        """Write the init record, or continue a stream, which already has one; returns the bytes written. Raises
        StorageError if there is a stream already and it may not be overwritten, or nothing can be written."""
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
        """Begin another period with the next packet; its init record is written and named at once. Raises StorageError
        if it cannot be written; earlier packets stay."""
        draft = with_period(self._opened(), header)
        size = draft.manifest.periods[-1].bytes
        self._header_bytes = max(self._header_bytes, size)
        self._check_room(draft, self._largest)
        self._publish(draft)
        return size

    def write(self, packet: Packet) -> int:
        """Write one packet; returns the bytes of its records. Raises StorageError if it cannot be written; earlier
        packets stay."""
        draft = self._opened()
        assert packet.index == draft.manifest.edge.frame + 1, "frames have no gaps"
        period = draft.manifest.periods[-1]
        begins = packet.index == period.first_frame
        assert packet.kind is PacketKind.KEY or not begins, "a period begins with a key packet"
        record = packed(RECORD_TYPES[packet.kind], packet.payload, period=period.period) + sound_record(packet)
        self._check_room(draft, len(record))
        part = part_of(record)
        self._put([(part.file, record)])
        if packet.kind is PacketKind.KEY:
            draft = with_segment(draft)
        elif not draft.records:
            draft = reopened(draft, self._store)
        captured = self._clocks.captured(packet.index)
        edge = Edge(packet.index, packet.pts_seconds, captured, self._clocks.wall())
        self._published.append(edge.published_unix_seconds)
        self._publish(with_frame(draft, part, record, edge))
        return len(record)

    def close(self) -> None:
        """Finish the group as a segment and say in the manifest that the run has ended. A second call does nothing.
        Raises StorageError if there is no room; all frames are safe."""
        draft = self._draft
        try:
            if draft is None or draft.manifest.edge.frame < 0:
                return
            draft = with_segment(draft)
            manifest = without_empty_period(draft.manifest)
            self._publish(replace(draft, manifest=replace(manifest, live=False)))
        finally:
            self._draft = None

    def _opened(self) -> Draft:
        assert self._draft is not None, "open() comes before write()"
        return self._draft

    def _continue(self, found: Draft) -> None:
        """Write what a killed run did not come to, and take up the stream where it ends."""
        self._header_bytes = found.manifest.periods[-1].bytes
        self._largest = max(map(len, found.records), default=0)
        self._put(found.files)
        self._retention.take_up(found.manifest)
        self._publish(replace(found, manifest=replace(found.manifest, live=True)))

    def _remove(self, there: frozenset[str]) -> int:
        """Remove the stream that is to be replaced, its manifest first; returns its last sequence number."""
        sequence = 0
        with suppress(StreamError):  # It is being replaced, whatever it says.
            sequence = read_manifest(self._store).sequence
        for name in sorted(there, key=lambda name: (name != MANIFEST, not name.startswith("init-"), name)):
            self._store.delete(name)
        return sequence

    def _publish(self, draft: Draft) -> None:
        """Write the files of a draft, then its manifest; then remove what has not been named for long enough."""
        self._put(draft.files)
        manifest = self._stamped(draft.manifest, self._retention.window(draft.manifest))
        self._put([(MANIFEST, manifest_to_json(manifest))])
        self._draft = Draft(manifest, draft.records)
        self._retention.published(manifest)

    def _stamped(self, manifest: Manifest, window: Window) -> Manifest:
        """The manifest with its next number, its window, and the pace of late."""
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
                self._retention.written(name)
        except StorageError as error:
            frames = 0 if self._draft is None else self._draft.manifest.edge.frame + 1
            raise StorageError(
                f"{error} The {frames} frames before are safe in it; make room and continue with --resume."
            ) from error

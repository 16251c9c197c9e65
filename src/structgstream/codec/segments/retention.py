# SPDX-License-Identifier: Apache-2.0
"""What of a stream of segments stays in its store: its window, what resuming needs, and what was named a while ago."""

from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, replace

from structgstream.codec.segments.history import segments_from
from structgstream.codec.segments.manifest import Manifest, PeriodEntry, SegmentEntry, Window
from structgstream.codec.segments.next_manifest import running_period
from structgstream.codec.segments.recovery import stale_files
from structgstream.codec.segments.store import Store
from structgstream.errors import StorageError


@dataclass(frozen=True)
class SegmentsOptions:
    """What of a stream is kept.

    Args:
        window_seconds: media seconds before the edge that viewers can go back; None for everything.
        grace_seconds: seconds that a file stays after the last manifest that named it.
    """

    window_seconds: float | None = None
    grace_seconds: float = 120.0


@dataclass(frozen=True)
class Turnover:
    """What a manifest changes of a window; nothing without one.

    Args:
        stay: segments in the window.
        leave: those that were in it before.
        window: of the manifest.
    """

    stay: tuple[SegmentEntry, ...]
    leave: tuple[SegmentEntry, ...]
    window: Window


class Retention:
    """Follows which files manifests name, and removes those that none has named for the time of grace.

    Args:
        store: where the files are.
        options: what is kept.
        elapsed: seconds that never jump.
    """

    def __init__(self, store: Store, options: SegmentsOptions, elapsed: Callable[[], float]) -> None:
        self._store, self._options, self._elapsed = store, options, elapsed
        self._present: tuple[SegmentEntry, ...] = ()  # segments in the window, if there is one
        self._needed: tuple[SegmentEntry, ...] = ()  # those that have left it and are needed to resume
        self._periods: tuple[PeriodEntry, ...] = ()  # of the last manifest
        self._leaving: dict[str, float] = {}  # files that no manifest names, and since when; oldest first

    def take_up(self, manifest: Manifest) -> None:
        """Begins with a stream that is there, whose last manifest this is.

        Raises:
            StreamError: a page of its history is missing or damaged.
        """
        there = self._store.names()
        if self._options.window_seconds is not None:
            first, needed = manifest.window.first_segment, running_period(manifest).first_segment
            listed = [*segments_from(self._store, manifest.history, manifest.segments, first=min(first, needed))]
            self._present = tuple(entry for entry in listed if entry.segment >= first)
            self._needed = tuple(entry for entry in listed if entry.segment == needed < first)
        self._leaving = dict.fromkeys(sorted(stale_files(manifest, there)), self._elapsed())

    def turnover(self, manifest: Manifest) -> Turnover:
        """What the window becomes with a manifest that is to be published."""
        window = replace(manifest.window, seconds=self._options.window_seconds)
        if window.seconds is None:
            return Turnover((), (), window)
        first = manifest.segments[0].segment if manifest.segments else 0
        listed = [entry for entry in manifest.segments if entry.segment >= manifest.window.first_segment]
        present = (*(entry for entry in self._present if entry.segment < first), *listed)
        start = manifest.edge.pts_seconds - window.seconds
        gone = next((i for i, entry in enumerate(present) if entry.pts_seconds[1] >= start), len(present))
        if gone:
            last = present[gone - 1]
            window = Window(last.first_frame + last.frames, last.segment + 1, window.seconds)
        return Turnover(present[gone:], present[:gone], window)

    def published(self, manifest: Manifest, turnover: Turnover, leaving: Iterable[str]) -> None:
        """Takes in that a manifest is there, and removes what has not been named for long enough.

        Args:
            manifest: that was written.
            turnover: what it has changed of the window.
            leaving: other files that it is the first not to name.
        """
        needed = running_period(manifest).first_segment  # Its first frame is needed to resume.
        left = (*self._needed, *turnover.leave)
        ended = {period.file for period in self._periods} - {period.file for period in manifest.periods}
        self._present, self._periods = turnover.stay, manifest.periods
        self._needed = tuple(entry for entry in left if entry.segment == needed)
        self._forget([*leaving, *sorted(ended), *(entry.file for entry in left if entry.segment != needed)])

    def written(self, name: str) -> None:
        """Takes in that a file was written: what a killed run had written too early may come again, and then stays."""
        self._leaving.pop(name, None)

    def _forget(self, leaving: Iterable[str]) -> None:
        now = self._elapsed()
        self._leaving |= dict.fromkeys(leaving, now)
        late = now - self._options.grace_seconds
        for name in [name for name, since in self._leaving.items() if since <= late]:
            del self._leaving[name]
            with suppress(StorageError):  # It is found again when the stream is resumed.
                self._store.delete(name)

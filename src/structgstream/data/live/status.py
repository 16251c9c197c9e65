# SPDX-License-Identifier: Apache-2.0
"""Faults and state of live cameras.

Faults are always counted, and logged when they begin and then at most once a minute.
"""

import logging
import threading
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum

log = logging.getLogger(__name__)

REPORT_INTERVAL_SECONDS = 60.0


class Fault(StrEnum):
    """Faults of a camera."""

    GONE = "gone"  # it cannot be opened, has ended, or sends nothing
    GARBAGE = "garbage"  # what it sent cannot be decoded; absent until the next key frame
    OTHER_SIZE = "other size"  # its picture is not of the calibration's size, or is interlaced, turned or mirrored
    STUCK = "stuck"  # the same picture while others change
    JUMP = "jump"  # its clock was reset
    DUPLICATE = "duplicate"  # the time stamp of an earlier picture
    REORDERED = "reordered"  # a time stamp before the last one
    BACKLOG = "backlog"  # the picture before came so long after it was taken that its time is unknown; left out
    NO_STAMP = "no stamp"
    OVERFLOW = "overflow"  # the queue was full: its oldest picture was dropped
    UNMATCHED = "unmatched"  # a picture that belonged to no set: late, between instants, or out of step


class FaultLog:
    """Counts faults by camera, and logs each kind at most once in :data:`REPORT_INTERVAL_SECONDS`. Thread-safe.

    ``now`` gives monotonic seconds.
    """

    def __init__(self, name: str, *, now: Callable[[], float]) -> None:
        self._name, self._now = name, now
        self._counts: defaultdict[str, Counter[str]] = defaultdict(Counter)
        self._reported: dict[tuple[str, str], float] = {}
        self._lock = threading.Lock()

    def count(self, camera: str, fault: Fault) -> None:
        """Counts without logging."""
        with self._lock:
            self._counts[camera][fault.value] += 1

    def report(self, camera: str, fault: Fault, text: str) -> None:
        """Counts, and logs unless this fault of this camera was logged a short time ago."""
        self.count(camera, fault)
        self.warn(camera, fault.value, text)

    def warn(self, camera: str, kind: str, text: str) -> None:
        """Logs without counting, as rarely as :meth:`report`."""
        with self._lock:
            now, last = self._now(), self._reported.get((camera, kind))
            if last is not None and now - last < REPORT_INTERVAL_SECONDS:
                return
            self._reported[camera, kind] = now
        log.warning("%s: camera %r %s", self._name, camera, text)

    @property
    def counts(self) -> dict[str, dict[str, int]]:
        """Number of occurrences by camera and fault."""
        with self._lock:
            return {camera: dict(found) for camera, found in self._counts.items()}


@dataclass(frozen=True)
class CameraStatus:
    """State of a camera."""

    present: bool = False  # whether it sends usable pictures, the next of which is not later than the deadline
    decoded: int = 0  # number of decoded pictures
    queued: int = 0  # number of pictures that wait to be matched
    faults: Mapping[str, int] = field(default_factory=dict)  # number of occurrences by kind


@dataclass(frozen=True)
class LiveStatus:
    """State of a live run. Ages are of the frame delivered last, seconds from capture; None if unknown."""

    cameras: Mapping[str, CameraStatus]  # by name
    sets: int = 0  # number of matched sets of pictures
    small_sets: int = 0  # of them, with too few training cameras for a frame
    skipped_sets: int = 0  # of them, replaced by a newer one before the trainer asked
    arrived_seconds: float | None = None  # age when the last picture arrived
    matched_seconds: float | None = None  # age when the set was complete
    delay_seconds: float | None = None  # age when the frame was delivered

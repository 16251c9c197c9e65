# SPDX-License-Identifier: Apache-2.0
"""What goes wrong with live cameras: counted always, logged when it begins and not again for a while."""

import logging
import threading
from collections import Counter, defaultdict
from collections.abc import Callable
from enum import StrEnum

log = logging.getLogger(__name__)

Now = Callable[[], float]
QUIET_SECONDS = 60.0


class Fault(StrEnum):
    """What can be wrong with a camera."""

    GONE = "gone"  # it cannot be opened, has ended, or sends nothing
    GARBAGE = "garbage"  # what came cannot be decoded; absent until the next key frame
    OTHER_SIZE = "other size"  # its picture is not the calibration's
    STUCK = "stuck"  # the same picture while others change
    JUMP = "jump"  # its clock was set
    DUPLICATE = "duplicate"  # a stamp that was there before
    REORDERED = "reordered"  # a stamp before the one before
    NO_STAMP = "no stamp"
    OVERFLOW = "overflow"  # the queue was full: its oldest picture was dropped
    UNMATCHED = "unmatched"  # a picture that belonged to no set: late, between instants, or out of step


class FaultLog:
    """Counts faults by camera, and tells the first of each kind at most once in ``quiet_seconds``.

    Args:
        name: of the rig, for messages.
        now: monotonic seconds.
        quiet_seconds: how long a kind of a camera is not told again.
    """

    def __init__(self, name: str, *, now: Now, quiet_seconds: float = QUIET_SECONDS) -> None:
        self._name, self._now, self._quiet = name, now, quiet_seconds
        self._counts: defaultdict[str, Counter[str]] = defaultdict(Counter)
        self._told: dict[tuple[str, str], float] = {}
        self._lock = threading.Lock()

    def count(self, camera: str, fault: Fault, times: int = 1) -> None:
        """Counts, and tells nothing."""
        with self._lock:
            self._counts[camera][fault.value] += times

    def tell(self, camera: str, fault: Fault, text: str) -> None:
        """Counts, and tells unless that kind of that camera was told a short time ago."""
        self.count(camera, fault)
        self.say(camera, fault.value, text)

    def say(self, camera: str, kind: str, text: str) -> None:
        """Tells without counting, as rarely as :meth:`tell`."""
        with self._lock:
            now, last = self._now(), self._told.get((camera, kind))
            if last is not None and now - last < self._quiet:
                return
            self._told[camera, kind] = now
        log.warning("%s: camera %r %s", self._name, camera, text)

    @property
    def counts(self) -> dict[str, dict[str, int]]:
        """Camera to fault to how often it was there."""
        with self._lock:
            return {camera: dict(found) for camera, found in self._counts.items()}

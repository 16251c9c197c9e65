# SPDX-License-Identifier: Apache-2.0
"""Times of one camera's pictures on the common clock, from stamps that may jump, repeat, go back or wrap.

Note [Least delay]
~~~~~~~~~~~~~~~~~~
A picture comes late by what encoder and network add, and they add something different to each. The least difference
of arrival and stamp over some seconds is steady to milliseconds, so with ``arrival`` a picture's time is its stamp plus
that least difference. It never falls behind a picture before: a new least difference puts a picture at its arrival, and
arrivals rise. As old differences are forgotten, a clock that runs fast or slow is followed.

A stamp is of a jumped clock if it goes back by more than :data:`JUMP_SECONDS`, or is that much earlier than the least
delay allows; pictures that a network held back come late, never early, so they are not taken for a jump.
"""

import threading
from dataclasses import dataclass

from structgstream.data.live.faults import Fault
from structgstream.data.live.rig_file import TimeBase

JUMP_SECONDS = 1.0
WINDOW_SECONDS = 15.0
SAME_SECONDS = 1e-6
ALIKE_SECONDS = 0.1


@dataclass(frozen=True)
class Placed:
    """Where a picture lies.

    Args:
        seconds: on the common clock; None if the picture is not to be used.
        fault: what was wrong with its stamp, or None.
        jump_seconds: by how much the camera's clock was set, with :attr:`Fault.JUMP`.
    """

    seconds: float | None
    fault: Fault | None = None
    jump_seconds: float = 0.0


class Jumps:
    """Corrections of clocks that were set, so that cameras whose common clock was set stay in step exactly."""

    def __init__(self) -> None:
        self._known: list[float] = []
        self._lock = threading.Lock()

    def common(self, correction: float) -> float:
        """The correction another camera had if it is about this one, else this one."""
        with self._lock:
            for known in self._known:
                if abs(known - correction) < ALIKE_SECONDS:
                    return known
            self._known = [*self._known[-15:], correction]
            return correction


class LeastDelay:
    """The least of values over the last :data:`WINDOW_SECONDS` to twice that (Note [Least delay])."""

    def __init__(self) -> None:
        self._began = -float("inf")
        self._before = self._now = float("inf")

    @property
    def value(self) -> float:
        """The least; infinite without any."""
        return min(self._before, self._now)

    def add(self, delay: float, at: float) -> None:
        """Adds a value of the time ``at``."""
        if at - self._began > WINDOW_SECONDS:
            self._began, self._before, self._now = at, self._now, float("inf")
        self._now = min(self._now, delay)

    def restart(self, delay: float, at: float) -> None:
        """Forgets everything but one value."""
        self._began, self._before, self._now = at, float("inf"), delay


class StampReader:
    """Places the pictures of one camera, in the order in which they are shown, across all its connections.

    Args:
        base: what says when a picture was taken.
        offset_seconds: added to every time.
        jumps: shared by the cameras.
    """

    def __init__(self, base: TimeBase, *, offset_seconds: float = 0.0, jumps: Jumps | None = None) -> None:
        self._base, self._offset = base, offset_seconds
        self._jumps = Jumps() if jumps is None else jumps
        self._least = LeastDelay()
        self._stamp: float | None = None
        self._seconds = -float("inf")
        self._shift = self._turns = 0.0
        self._fresh = False

    @property
    def shift(self) -> float:
        """What is added to a stamp as it comes, to get the time on the common clock."""
        least = self._least.value if self._base is TimeBase.ARRIVAL else self._shift
        return self._turns + least + self._offset

    def reconnect(self) -> None:
        """The next picture is the first of a new connection, whose stamps may begin anew without a fault."""
        self._fresh = True

    def place(self, stamp: float, *, arrived: float, wrap_seconds: float | None = None) -> Placed:
        """Where the next picture lies.

        Args:
            stamp: of the picture, seconds.
            arrived: when it came, Unix time by a clock that is never set.
            wrap_seconds: after which stamps begin again; None for never.
        """
        if self._stamp is None:
            return self._begin(stamp, arrived, wrap_seconds)
        if wrap_seconds is not None:  # the turn that brings it nearest: FFmpeg may have added one of its own
            self._turns = round((self._stamp - stamp) / wrap_seconds) * wrap_seconds
        stamp += self._turns
        step, delay, fresh = stamp - self._stamp, arrived - stamp, self._fresh
        self._fresh = False
        if fresh and (step <= 0 or delay < self._least.value - JUMP_SECONDS):
            return Placed(self._jumped(stamp, delay, arrived).seconds)
        if abs(step) < SAME_SECONDS:
            return Placed(None, Fault.DUPLICATE)
        if step <= -JUMP_SECONDS or delay < self._least.value - JUMP_SECONDS:
            return self._jumped(stamp, delay, arrived)
        if step < 0:
            return Placed(None, Fault.REORDERED)
        self._least.add(delay, arrived)
        return self._placed(stamp)

    def _begin(self, stamp: float, arrived: float, wrap_seconds: float | None) -> Placed:
        if self._base is TimeBase.UNIX and wrap_seconds is not None:
            self._shift = round((arrived - stamp) / wrap_seconds) * wrap_seconds
        self._least.restart(arrived - stamp, arrived)
        return self._placed(stamp)

    def _jumped(self, stamp: float, delay: float, arrived: float) -> Placed:
        """The pictures go on as late as they came before the jump."""
        correction = delay - self._least.value
        if self._base is not TimeBase.ARRIVAL:
            common = self._jumps.common(correction)
            self._shift += common
            # The least delay of this camera is the one before, by the clock as it is now.
            delay = self._least.value + common
        self._least.restart(delay, arrived)
        placed = self._placed(stamp)
        return Placed(placed.seconds, Fault.JUMP, -correction)

    def _placed(self, stamp: float) -> Placed:
        self._stamp = stamp
        shift = self._least.value if self._base is TimeBase.ARRIVAL else self._shift
        seconds = stamp + shift + self._offset
        if seconds <= self._seconds:
            return Placed(None, Fault.REORDERED)
        self._seconds = seconds
        return Placed(seconds)

# SPDX-License-Identifier: Apache-2.0
"""Times of one camera's pictures on the common clock, from time stamps that may jump, repeat, go back or wrap.

Note [Minimum delay]
~~~~~~~~~~~~~~~~~~~~
Encoder and network delay each picture by another amount. The minimum of arrival minus stamp over some seconds is steady
to milliseconds, so with ``arrival`` a picture's time is its stamp plus that minimum. Times never decrease: a new
minimum puts a picture at its arrival, and arrivals increase. Old differences expire, so clocks that run fast or slow
are tracked.

A clock was reset if a stamp goes back by more than :data:`RESET_SECONDS`, or is that much earlier than the minimum
delay allows. Pictures that a network delayed come late, never early, so they do not look like a reset.
"""

import threading
from dataclasses import dataclass

from structgstream.data.live.rig_file import TimeBase
from structgstream.data.live.status import Fault

RESET_SECONDS = 1.0
WINDOW_SECONDS = 15.0
DUPLICATE_SECONDS = 1e-6
SAME_RESET_SECONDS = 0.1


@dataclass(frozen=True)
class PictureTime:
    """When a picture was taken."""

    seconds: float | None  # on the common clock; None if the picture must not be used
    fault: Fault | None = None  # what was wrong with its time stamp, or None
    reset_seconds: float = 0.0  # by how much the camera's clock was reset, with :attr:`Fault.JUMP`


class ClockResets:
    """Corrections for clock resets, shared by the cameras: those of one common clock get one correction, and so stay
    synchronised exactly. Thread-safe."""

    def __init__(self) -> None:
        self._known: list[float] = []
        self._lock = threading.Lock()

    def common(self, correction: float) -> float:
        """The correction of another camera if it is within 0.1 s of this one, else this one."""
        with self._lock:
            for known in self._known:
                if abs(known - correction) < SAME_RESET_SECONDS:
                    return known
            self._known = [*self._known[-15:], correction]
            return correction


class MinimumDelayFilter:
    """Minimum of delays over the last :data:`WINDOW_SECONDS` to twice that (Note [Minimum delay])."""

    def __init__(self) -> None:
        self._window_start = -float("inf")
        self._previous = self._current = float("inf")

    @property
    def value(self) -> float:
        """The minimum, seconds; infinite without any delay."""
        return min(self._previous, self._current)

    def add(self, delay: float, at: float) -> None:
        """Adds a delay, measured at the time ``at``."""
        if at - self._window_start > WINDOW_SECONDS:
            self._window_start, self._previous, self._current = at, self._current, float("inf")
        self._current = min(self._current, delay)

    def restart(self, delay: float, at: float) -> None:
        """Starts again from one delay."""
        self._window_start, self._previous, self._current = at, float("inf"), delay


class ClockMapper:
    """Maps the time stamps of one camera to the common clock, in the order of presentation, across all its connections.

    Args:
        base: which clock states when a picture was taken.
        offset_seconds: added to every time.
        resets: shared by the cameras.
    """

    def __init__(self, base: TimeBase, *, offset_seconds: float = 0.0, resets: ClockResets | None = None) -> None:
        self._base, self._offset = base, offset_seconds
        self._resets = ClockResets() if resets is None else resets
        self._delay = MinimumDelayFilter()
        self._stamp: float | None = None
        self._seconds = -float("inf")
        self._shift = self._wrapped = 0.0
        self._reconnected = False

    @property
    def shift(self) -> float:
        """What is added to a stamp as it comes, to get the time on the common clock; seconds."""
        shift = self._delay.value if self._base is TimeBase.ARRIVAL else self._shift
        return self._wrapped + shift + self._offset

    def reconnect(self) -> None:
        """The next picture is the first of a new connection, whose stamps may start again without a fault."""
        self._reconnected = True

    def map(self, stamp: float, *, arrived: float, wrap_seconds: float | None = None) -> PictureTime:
        """The time of the next picture.

        Args:
            stamp: of the picture, seconds.
            arrived: when it arrived, Unix time by a monotonic clock.
            wrap_seconds: period after which stamps wrap around; None for never.
        """
        if self._stamp is None:
            return self._first(stamp, arrived, wrap_seconds)
        if wrap_seconds is not None:  # the number of wraps that brings it nearest: FFmpeg may have added one of its own
            self._wrapped = round((self._stamp - stamp) / wrap_seconds) * wrap_seconds
        stamp += self._wrapped
        step, delay, reconnected = stamp - self._stamp, arrived - stamp, self._reconnected
        self._reconnected = False
        if reconnected and (step <= 0 or delay < self._delay.value - RESET_SECONDS):
            return PictureTime(self._after_reset(stamp, delay, arrived).seconds)
        if abs(step) < DUPLICATE_SECONDS:
            return PictureTime(None, Fault.DUPLICATE)
        if step <= -RESET_SECONDS or delay < self._delay.value - RESET_SECONDS:
            return self._after_reset(stamp, delay, arrived)
        if step < 0:
            return PictureTime(None, Fault.REORDERED)
        self._delay.add(delay, arrived)
        return self._mapped(stamp)

    def _first(self, stamp: float, arrived: float, wrap_seconds: float | None) -> PictureTime:
        if self._base is TimeBase.UNIX and wrap_seconds is not None:
            self._shift = round((arrived - stamp) / wrap_seconds) * wrap_seconds
        self._delay.restart(arrived - stamp, arrived)
        return self._mapped(stamp)

    def _after_reset(self, stamp: float, delay: float, arrived: float) -> PictureTime:
        """The pictures continue with the delay that they had before the reset."""
        correction = delay - self._delay.value
        if self._base is not TimeBase.ARRIVAL:
            common = self._resets.common(correction)
            self._shift += common
            # The minimum delay of this camera is the one before, by the clock as it is now.
            delay = self._delay.value + common
        self._delay.restart(delay, arrived)
        return PictureTime(self._mapped(stamp).seconds, Fault.JUMP, -correction)

    def _mapped(self, stamp: float) -> PictureTime:
        self._stamp = stamp
        shift = self._delay.value if self._base is TimeBase.ARRIVAL else self._shift
        seconds = stamp + shift + self._offset
        if seconds <= self._seconds:
            return PictureTime(None, Fault.REORDERED)
        self._seconds = seconds
        return PictureTime(seconds)

# SPDX-License-Identifier: Apache-2.0
"""Synchronises the pictures of several cameras: sets of one instant.

Note [Picture sets]
~~~~~~~~~~~~~~~~~~~
The first camera that is present is the reference: each of its pictures is an instant, and every other camera gives the
nearest picture within a tolerance. So cameras may run at any phase and at slightly different rates. A picture is in one
set at most. A set is complete when each present camera has sent a picture at or after its instant, or when the deadline
has passed since the reference picture arrived; cameras without a picture are absent from it.

Instants increase, except where a camera whose clock is ahead led before the others came: pictures that are earlier than
the last instant by more than :data:`MAX_LATE_SECONDS` are not late, and lead again.
"""

import threading
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from structgstream.data.live.status import Fault

MIN_SPACING = 0.75
"""Minimum share of a frame period between two instants: of a faster reference camera, pictures are left out."""
MAX_LATE_SECONDS = 60.0
"""Later than its reference no picture comes: a connection that stalls is opened again before (``silent_seconds``)."""


@dataclass(frozen=True)
class LivePicture:
    """A picture of a camera."""

    seconds: float  # when it was taken, on the common clock
    arrived: float  # when it arrived, monotonic seconds
    content: Any  # a decoded frame of PyAV


@dataclass(frozen=True)
class PictureSet:
    """Pictures of one instant."""

    seconds: float  # the instant, on the common clock
    pictures: Mapping[str, LivePicture]  # by camera, in the rig's order; cameras without one are missing
    matched: float  # when the set was complete, monotonic seconds

    @property
    def arrived(self) -> float:
        """When its last picture arrived, monotonic seconds."""
        return max(picture.arrived for picture in self.pictures.values())


@dataclass
class _Queue:
    pictures: deque[LivePicture] = field(default_factory=deque)
    last_arrived: float = -float("inf")
    misses: int = 0
    distance_seconds: float = 0.0


class FrameSynchronizer:
    """Pictures in, sets out (Note [Picture sets]). It has no clock and no thread. Cameras' threads add pictures.

    Args:
        cameras: names, in the rig's order.
        fps: frames per second of the stream; sets are at least :data:`MIN_SPACING` of a period apart.
        tolerance_seconds: maximum distance of a picture from the instant.
        deadline_seconds: how long a set waits for its pictures.
        queue_frames: maximum number of waiting pictures of a camera; the oldest are dropped.
        started: when the cameras were opened; they count as present as if they had sent a picture then.
    """

    def __init__(
        self,
        cameras: Iterable[str],
        *,
        fps: float,
        tolerance_seconds: float,
        deadline_seconds: float,
        queue_frames: int,
        count: Callable[[str, Fault], None],
        started: float = -float("inf"),
    ) -> None:
        self._queues = {name: _Queue(last_arrived=started) for name in cameras}
        self._spacing = MIN_SPACING / fps
        self._tolerance, self._deadline = tolerance_seconds, deadline_seconds
        self._present = deadline_seconds + 1 / fps  # from one picture to the next at most
        self._max_queue, self._count = queue_frames, count
        self._last = -float("inf")
        self.changed = threading.Condition()  # the lock, which is notified when another set may be complete
        self.last_arrived = started  # monotonic seconds

    def add(self, camera: str, picture: LivePicture) -> None:
        """Adds a picture, whose time is after the camera's last one."""
        queue = self._queues[camera]
        with self.changed:
            queue.last_arrived = self.last_arrived = picture.arrived
            queue.pictures.append(picture)
            if len(queue.pictures) > self._max_queue:
                queue.pictures.popleft()
                self._count(camera, Fault.OVERFLOW)
            self.changed.notify()

    def mark_absent(self, camera: str) -> None:
        """Sets do not wait for the camera until it sends again."""
        with self.changed:
            self._queues[camera].last_arrived = -float("inf")
            self.changed.notify()

    def present(self, now: float) -> list[str]:
        """The cameras whose next picture is not later than the deadline, in the rig's order."""
        return [name for name, queue in self._queues.items() if now - queue.last_arrived <= self._present]

    def out_of_step(self, sets: int) -> dict[str, float]:
        """Cameras that send but were in none of the last ``sets`` sets, and their distance from the last instant,
        seconds."""
        return {name: queue.distance_seconds for name, queue in self._queues.items() if queue.misses >= sets}

    @property
    def queue_lengths(self) -> dict[str, int]:
        """Number of waiting pictures by camera."""
        return {name: len(queue.pictures) for name, queue in self._queues.items()}

    def next_set(self, now: float) -> PictureSet | None:
        """The next set that is complete at ``now``; None if none is. The caller, the only one, holds the lock."""
        present = self.present(now)
        reference = self._reference(present)
        if reference is None:
            return None
        expired = now - reference.arrived >= self._deadline
        if not expired and not all(self._has_passed(name, reference.seconds) for name in present):
            return None
        nearest = ((name, self._take_nearest(name, reference.seconds)) for name in self._queues)
        pictures = {name: picture for name, picture in nearest if picture is not None}
        self._last = reference.seconds
        for name in present:
            self._queues[name].misses = 0 if name in pictures else self._queues[name].misses + 1
        return PictureSet(reference.seconds, pictures, now)

    def _reference(self, present: list[str]) -> LivePicture | None:
        """The reference camera's first picture that is far enough from the last set."""
        # Pictures of cameras that have become absent still make sets, after those of present ones.
        for name in (*present, *(name for name in self._queues if name not in present)):
            pictures = self._queues[name].pictures
            while pictures and -MAX_LATE_SECONDS < pictures[0].seconds - self._last < self._spacing:
                self._drop_first(name)
            if pictures:
                return pictures[0]
            if name in present:
                return None
        return None

    def _has_passed(self, name: str, seconds: float) -> bool:
        """Whether the camera has sent a picture at or after an instant."""
        pictures = self._queues[name].pictures
        return bool(pictures) and pictures[-1].seconds >= seconds

    def _take_nearest(self, name: str, seconds: float) -> LivePicture | None:
        """The camera's picture that is nearest to the instant; those before it are in no set."""
        pictures = self._queues[name].pictures
        nearest = min(pictures, key=lambda picture: abs(picture.seconds - seconds), default=None)
        if nearest is not None and abs(nearest.seconds - seconds) > self._tolerance:
            self._queues[name].distance_seconds = nearest.seconds - seconds
            nearest = None
        if nearest is None:
            while pictures and pictures[0].seconds <= seconds - self._tolerance:
                self._drop_first(name)
            return None
        while pictures[0] is not nearest:
            self._drop_first(name)
        return pictures.popleft()

    def _drop_first(self, name: str) -> None:
        self._queues[name].pictures.popleft()
        self._count(name, Fault.UNMATCHED)

# SPDX-License-Identifier: Apache-2.0
"""Matches pictures of several cameras to sets of one instant.

Note [Sets]
~~~~~~~~~~~
The first camera that is present leads: each of its pictures is an instant, and every other camera gives the picture
that lies nearest to it within a tolerance. So cameras may run at any phase and at rates that are not quite the same. A
picture is in one set at most. A set is ready when each camera that is present has sent a picture at or after its
instant, or when the deadline has passed since the leader's picture came; cameras without a picture are absent from it.
"""

from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from structgstream.data.live.faults import Fault

MIN_SPACING = 0.75
"""Of a frame's length between two instants: a leader that runs faster gives every second picture or fewer."""
Count = Callable[[str, Fault, int], None]


@dataclass(frozen=True)
class LivePicture:
    """A picture of a camera.

    Args:
        seconds: when it was taken, on the common clock.
        arrived: when it came, monotonic seconds.
        content: a decoded frame, or what stands for it.
    """

    seconds: float
    arrived: float
    content: Any


@dataclass(frozen=True)
class PictureSet:
    """Pictures of one instant.

    Args:
        seconds: the instant, on the common clock.
        pictures: by camera, in the rig's order; cameras without one are missing.
        matched: when the set was ready, monotonic seconds.
    """

    seconds: float
    pictures: Mapping[str, LivePicture]
    matched: float

    @property
    def times(self) -> "SetTimes":
        """When its pictures were there, and when they were a set."""
        return SetTimes(max(picture.arrived for picture in self.pictures.values()), self.matched)


@dataclass(frozen=True)
class SetTimes:
    """When the last picture of a set came, and when the set was ready; monotonic seconds."""

    arrived: float
    matched: float


@dataclass
class _Queue:
    pictures: deque[LivePicture] = field(default_factory=deque)
    last_arrived: float = -float("inf")
    misses: int = 0
    off_seconds: float = 0.0


class SetMatcher:
    """Pictures in, sets out (Note [Sets]). It has no clock and no thread; callers lock it.

    Args:
        cameras: names, in the rig's order.
        fps: sets a second at most.
        tolerance_seconds: how far a picture may lie from the instant.
        deadline_seconds: how long a set waits.
        queue_frames: pictures of a camera that are kept; the oldest are dropped.
        count: told of dropped and unmatched pictures.
        begun: when cameras were opened, from which on they are waited for as if they had sent.
    """

    def __init__(
        self,
        cameras: Iterable[str],
        *,
        fps: float,
        tolerance_seconds: float,
        deadline_seconds: float,
        queue_frames: int,
        count: Count,
        begun: float = -float("inf"),
    ) -> None:
        self._queues = {name: _Queue(last_arrived=begun) for name in cameras}
        self._spacing = MIN_SPACING / fps
        self._tolerance, self._deadline = tolerance_seconds, deadline_seconds
        self._most, self._count = queue_frames, count
        self._last = -float("inf")

    def add(self, camera: str, picture: LivePicture) -> None:
        """Adds a picture, whose time is after the camera's last one."""
        queue = self._queues[camera]
        queue.last_arrived = picture.arrived
        queue.pictures.append(picture)
        if len(queue.pictures) > self._most:
            queue.pictures.popleft()
            self._count(camera, Fault.OVERFLOW, 1)

    def forget(self, camera: str) -> None:
        """The camera has gone: sets do not wait for it until it sends again."""
        self._queues[camera].last_arrived = -float("inf")

    def present(self, now: float) -> list[str]:
        """The cameras that sent a picture within the deadline, in the rig's order."""
        return [name for name, queue in self._queues.items() if now - queue.last_arrived <= self._deadline]

    def out_of_step(self, sets: int) -> dict[str, float]:
        """Cameras that send but were in none of the last ``sets`` sets, and how far from the last instant they were."""
        return {name: queue.off_seconds for name, queue in self._queues.items() if queue.misses >= sets}

    @property
    def lengths(self) -> dict[str, int]:
        """Pictures that wait, by camera."""
        return {name: len(queue.pictures) for name, queue in self._queues.items()}

    def next_set(self, now: float) -> PictureSet | None:
        """The next set that is ready at ``now``; None if none is."""
        present = self.present(now)
        lead = self._instant(present)
        if lead is None:
            return None
        late = now - lead.arrived >= self._deadline
        waiting = (name for name in present if not self._decided(name, lead.seconds))
        if not late and next(waiting, None) is not None:
            return None
        taken = {name: found for name in self._queues if (found := self._take(name, lead.seconds)) is not None}
        self._last = lead.seconds
        for name in present:
            self._queues[name].misses = 0 if name in taken else self._queues[name].misses + 1
        return PictureSet(lead.seconds, taken, now)

    def _instant(self, present: list[str]) -> LivePicture | None:
        """The leader's first picture that is far enough from the last set."""
        # Pictures of cameras that have gone in the meantime still make sets, after those of present ones.
        for name in (*present, *(name for name in self._queues if name not in present)):
            pictures = self._queues[name].pictures
            while pictures and pictures[0].seconds < self._last + self._spacing:
                self._leave(name, pictures.popleft())
            if pictures:
                return pictures[0]
            if name in present:
                return None
        return None

    def _decided(self, name: str, seconds: float) -> bool:
        pictures = self._queues[name].pictures
        return bool(pictures) and pictures[-1].seconds >= seconds

    def _take(self, name: str, seconds: float) -> LivePicture | None:
        """The camera's picture that is nearest to the instant; those before it belong to no set."""
        pictures = self._queues[name].pictures
        best = min(pictures, key=lambda picture: abs(picture.seconds - seconds), default=None)
        if best is not None and abs(best.seconds - seconds) > self._tolerance:
            self._queues[name].off_seconds = best.seconds - seconds
            best = None
        while pictures and (pictures[0] is best or pictures[0].seconds <= seconds - self._tolerance):
            first = pictures.popleft()
            if first is best:
                return best
            self._leave(name, first)
        if best is not None:
            while pictures[0] is not best:
                self._leave(name, pictures.popleft())
            return pictures.popleft()
        return None

    def _leave(self, name: str, picture: LivePicture) -> None:
        self._count(name, Fault.UNMATCHED, 1)

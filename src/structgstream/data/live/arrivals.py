# SPDX-License-Identifier: Apache-2.0
"""All cameras of a live run at work: their threads, and one that makes sets of what they send."""

import threading
from collections.abc import Callable, Mapping
from typing import Any

from structgstream.data.live.camera import CameraFeed, Opens
from structgstream.data.live.faults import Fault, FaultLog
from structgstream.data.live.matching import LivePicture, SetMatcher
from structgstream.data.live.outlets import Outlet
from structgstream.data.live.recording import Recording
from structgstream.data.live.rig_file import LiveRig
from structgstream.data.live.stamps import Jumps, StampReader

TICK_SECONDS = 0.02
MISSED_SETS = 30  # before a camera is told to be out of step
JOIN_SECONDS = 1.0


class Arrivals:
    """Cameras' pictures on their way to an outlet, as complete sets.

    Args:
        rig: the content of the rig file.
        sizes: width and height of each camera's pictures as they were calibrated.
        fps: sets a second at most.
        faults: is told what is wrong.
        outlet: takes the sets.
        recording: keeps packets, or None.
        now: monotonic seconds.
        unix_offset: what makes them Unix time.
        opens: opens a camera with a timeout; None for PyAV.
    """

    def __init__(
        self,
        rig: LiveRig,
        *,
        sizes: Mapping[str, tuple[int, int]],
        fps: float,
        faults: FaultLog,
        outlet: Outlet,
        recording: Recording | None,
        now: Callable[[], float],
        unix_offset: float,
        opens: Opens | None = None,
    ) -> None:
        self._rig, self._faults, self._outlet, self._now = rig, faults, outlet, now
        self._matcher = SetMatcher(
            sizes,
            fps=fps,
            tolerance_seconds=rig.tolerance_seconds or 0.5 / fps,
            deadline_seconds=rig.deadline_seconds,
            queue_frames=rig.queue_frames,
            count=faults.count,
            begun=now(),
        )
        self._arrived = threading.Condition()
        self._stop = threading.Event()
        self._last_arrival = self._begun = now()
        self._failed: BaseException | None = None
        self.sets = self.small = 0
        jumps = Jumps()
        common: dict[str, Any] = {
            "receiver": self, "faults": faults, "base": rig.clock, "now": now, "unix_offset": unix_offset,
            "silent_seconds": rig.silent_seconds, "stuck_seconds": rig.stuck_seconds, "opens": opens,
        }  # fmt: skip
        self.feeds = {
            name: CameraFeed(
                name,
                camera,
                size=sizes[name],
                stamps=StampReader(rig.clock, offset_seconds=camera.offset_seconds, jumps=jumps),
                keeper=None if recording is None else recording.camera(name, faults),
                **common,
            )
            for name, camera in rig.cameras.items()
        }
        self._thread = threading.Thread(target=self._make_sets, name="sets", daemon=True)

    def start(self) -> None:
        """Opens all cameras."""
        self._thread.start()
        for feed in self.feeds.values():
            feed.start()

    def stop(self) -> None:
        """Ends all threads, waiting a moment for each."""
        self._stop.set()
        for feed in self.feeds.values():
            feed.stop()
        for thread in (self._thread, *self.feeds.values()):
            thread.join(JOIN_SECONDS)

    def deliver(self, camera: str, picture: LivePicture) -> None:
        """See ``camera.Receiver``."""
        with self._arrived:
            self._matcher.add(camera, picture)
            self._last_arrival = picture.arrived
            self._arrived.notify()

    def lost(self, camera: str) -> None:
        """See ``camera.Receiver``."""
        with self._arrived:
            self._matcher.forget(camera)
            self._arrived.notify()

    def others_changed_at(self, camera: str) -> float:
        """See ``camera.Receiver``."""
        return max((feed.changed_at for name, feed in self.feeds.items() if name != camera), default=-float("inf"))

    def count_small(self) -> None:
        """A set had pictures of too few training cameras."""
        self.small += 1

    @property
    def lengths(self) -> dict[str, int]:
        """Pictures that wait to be matched, by camera."""
        with self._arrived:
            return self._matcher.lengths

    @property
    def present(self) -> list[str]:
        """Cameras that sent a usable picture within the deadline."""
        with self._arrived:
            return self._matcher.present(self._now())

    @property
    def coming(self) -> list[str]:
        """Cameras of which pictures may still come: all but files that have ended or cannot be read."""
        return [name for name, feed in self.feeds.items() if not feed.ended]

    @property
    def ended(self) -> str | None:
        """Why nothing comes any more, or None.

        Raises:
            BaseException: what ended the thread that makes sets.
        """
        if self._failed is not None:
            raise self._failed
        if not self.coming and not self._outlet.status.waiting and self._idle:
            return "all files of cameras have come to their end, or cannot be read"
        limit, silent = self._rig.end_seconds, self._now() - self._last_arrival
        if limit is not None and silent > limit and not self._outlet.status.waiting:
            return f"no camera has sent a picture for {silent:.0f} s, so the stream ends (end_seconds in the rig file)"
        return None

    def waiting_for(self) -> str:
        """What is lacking for a set, for a message."""
        present = self.present
        lacking = [name for name in self.feeds if name not in present]
        return f"{len(present)} of {len(self.feeds)} cameras send; absent: {', '.join(lacking) or 'none'}"

    @property
    def _idle(self) -> bool:
        with self._arrived:
            return not any(self._matcher.lengths.values())

    def _make_sets(self) -> None:
        try:
            while not self._stop.is_set():
                with self._arrived:
                    found = self._matcher.next_set(self._now())
                    if found is None:
                        self._arrived.wait(TICK_SECONDS)
                        continue
                    astray = self._matcher.out_of_step(MISSED_SETS)
                self.sets += 1
                self._outlet.put(found)
                self._tell_astray(astray)
        except BaseException as error:  # handed to the trainer's thread, whatever it is
            self._failed = error

    def _tell_astray(self, astray: Mapping[str, float]) -> None:
        for name, seconds in astray.items():
            if seconds < 0:
                why = (
                    f"are {-seconds:.3f} s behind those of the others: either they come late, which a longer "
                    "deadline_seconds or a less busy machine mends, or its clock is"
                )
            else:
                why = f"are {seconds:.3f} s ahead of those of the others: its clock is"
            text = (
                f"is absent, because its pictures {why}, which offset_seconds = {-seconds:+.3f} in the rig file mends"
            )
            self._faults.say(name, Fault.UNMATCHED.value, text)

# SPDX-License-Identifier: Apache-2.0
"""Ingest of all cameras of a live run: a thread per camera, and one that synchronises their pictures into sets."""

import threading
from collections.abc import Callable, Mapping

from structgstream.data.live.camera import CameraFeed, ClockResets
from structgstream.data.live.recorder import Recording
from structgstream.data.live.rig_file import LiveRig
from structgstream.data.live.status import Fault, FaultLog
from structgstream.data.live.synchronizer import FrameSynchronizer, PictureSet
from structgstream.data.sound import LiveSound

TICK_SECONDS = 0.02
MAX_MISSED_SETS = 30  # before a camera is reported as out of step
JOIN_SECONDS = 1.0


class Ingest:
    """Cameras' pictures as complete sets, of which the newest waits until it is taken.

    Args:
        sizes: width and height of each camera's pictures as they were calibrated, pixels.
        fps: frames per second of the stream; faster cameras give up to 4/3 as many sets (``MIN_SPACING``).
        now: monotonic seconds.
        unix_offset: Unix time minus ``now``, seconds.
        sound: receives the sound of the camera that it names; None for none.
    """

    def __init__(
        self,
        rig: LiveRig,
        *,
        sizes: Mapping[str, tuple[int, int]],
        fps: float,
        faults: FaultLog,
        recording: Recording | None,
        now: Callable[[], float],
        unix_offset: float,
        sound: LiveSound | None = None,
    ) -> None:
        self._rig, self._faults, self._now = rig, faults, now
        self._synchronizer = FrameSynchronizer(
            sizes,
            fps=fps,
            tolerance_seconds=rig.tolerance_seconds or 0.5 / fps,
            deadline_seconds=rig.deadline_seconds,
            queue_frames=rig.queue_frames,
            count=faults.count,
            started=now(),
        )
        self._stop = threading.Event()
        self._failure: BaseException | None = None
        self._newest: PictureSet | None = None
        self._complete = threading.Condition()
        self.sets = 0
        self.skipped_sets = 0  # replaced by a newer one before they were taken
        resets, changed_at = ClockResets(), dict.fromkeys(rig.cameras, -float("inf"))
        self.feeds = {
            name: CameraFeed(
                name,
                rig,
                size=sizes[name],
                synchronizer=self._synchronizer,
                changed_at=changed_at,
                resets=resets,
                faults=faults,
                now=now,
                unix_offset=unix_offset,
                recorder=None if recording is None else recording.camera(name, faults),
                sound=sound if sound is not None and sound.name == name else None,
            )
            for name in rig.cameras
        }
        self._thread = threading.Thread(target=self._synchronize, name="synchronizer", daemon=True)

    def start(self) -> None:
        """Opens all cameras."""
        self._thread.start()
        for feed in self.feeds.values():
            feed.start()

    def stop(self) -> None:
        """Ends all threads; waits at most a second for each."""
        self._stop.set()
        for feed in self.feeds.values():
            feed.stop()
        for thread in (self._thread, *self.feeds.values()):
            thread.join(JOIN_SECONDS)

    def take(self, timeout_seconds: float) -> PictureSet | None:
        """The newest set that was not taken yet; None if there was none in time."""
        with self._complete:
            if self._newest is None:
                self._complete.wait(timeout_seconds)
            pictures, self._newest = self._newest, None
        return pictures

    @property
    def queue_lengths(self) -> dict[str, int]:
        """Number of pictures that wait to be matched, by camera."""
        return self._synchronizer.queue_lengths

    @property
    def present(self) -> list[str]:
        """Cameras that send usable pictures, the next of which is not later than the deadline."""
        return self._synchronizer.present(self._now())

    @property
    def open_cameras(self) -> list[str]:
        """Cameras that may still send: all but files that have ended or cannot be read."""
        return [name for name, feed in self.feeds.items() if not feed.ended]

    @property
    def end_reason(self) -> str | None:
        """Why no more pictures will arrive; None while they may. Raises what ended the synchroniser's thread."""
        if self._failure is not None:
            raise self._failure
        if self._newest is not None:
            return None
        if not self.open_cameras and not any(self.queue_lengths.values()):
            return "all files of cameras have come to their end, or cannot be read"
        limit, silent = self._rig.end_seconds, self._now() - self._synchronizer.last_arrived
        if limit is not None and silent > limit:
            return f"no camera has sent a picture for {silent:.0f} s, so the stream ends (end_seconds in the rig file)"
        return None

    def describe_absent(self) -> str:
        """How many cameras are present, and which are absent, for a message."""
        present = self.present
        absent = [name for name in self.feeds if name not in present]
        return f"{len(present)} of {len(self.feeds)} cameras send; absent: {', '.join(absent) or 'none'}"

    def _synchronize(self) -> None:
        try:
            while not self._stop.is_set():
                with self._synchronizer.changed:
                    pictures = self._synchronizer.next_set(self._now())
                    if pictures is None:
                        self._synchronizer.changed.wait(TICK_SECONDS)
                        continue
                    out_of_step = self._synchronizer.out_of_step(MAX_MISSED_SETS)
                with self._complete:
                    self.sets += 1
                    self.skipped_sets += self._newest is not None
                    self._newest = pictures
                    self._complete.notify()
                self._warn_out_of_step(out_of_step)
        except BaseException as error:  # raised in the trainer's thread
            self._failure = error

    def _warn_out_of_step(self, cameras: Mapping[str, float]) -> None:
        late = "either they come late, which a longer deadline_seconds or a less busy machine mends, or its clock is"
        for name, seconds in cameras.items():
            side, cause = ("behind", late) if seconds < 0 else ("ahead of", "its clock is")
            text = (
                f"is absent, because its pictures are {abs(seconds):.3f} s {side} those of the others: {cause}, which "
                f"offset_seconds = {-seconds:+.3f} in the rig file mends"
            )
            self._faults.warn(name, Fault.UNMATCHED.value, text)

# SPDX-License-Identifier: Apache-2.0
"""Live cameras as a stream of frames whose length nobody knows."""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import TracebackType
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from structgstream.cameras import CameraRig
from structgstream.data.denoising import DenoisingConfig, mean_of_still
from structgstream.data.live.arrivals import Arrivals
from structgstream.data.live.calibration import (
    Arriving,
    as_calibrated,
    chosen_cameras,
    filmed_rig,
    filmed_sizes,
    read_calibration,
)
from structgstream.data.live.faults import Fault, FaultLog
from structgstream.data.live.kept import KeptFrames, kept_folder
from structgstream.data.live.matching import PictureSet, SetTimes
from structgstream.data.live.outlets import GIGABYTE, Convert, DiskQueue, Latest, Outlet
from structgstream.data.live.recording import Recording
from structgstream.data.live.rig_file import LiveRig, TimeBase, check_cameras, read_rig
from structgstream.data.live.status import LiveStatus, SetAges
from structgstream.data.source import FrameSource
from structgstream.data.video_index import load_av
from structgstream.data.video_pictures import srgb
from structgstream.errors import CaptureError, ConfigError, StorageError
from structgstream.frames import MIN_CAMERAS, MultiViewFrame

log = logging.getLogger(__name__)

Policy = Literal["latest", "every"]
POLL_SECONDS = 0.2
QUEUE_GIGABYTES = 10.0
HEARTBEAT_SECONDS = 5.0
AHEAD_SECONDS = 5.0  # for the sets that frame 0 is averaged with
LATEST_KNOWN = 16  # frames of which it is remembered when they were filmed


@dataclass(frozen=True)
class LiveOptions:
    """What a live run is asked for.

    Args:
        policy: ``latest`` hands out the newest complete set, ``every`` all of them, which wait on the disk.
        frames: number of frames after which the stream ends; None for no end.
        held_out: see ``open_capture``.
        scale: see ``open_capture``.
        near: see ``open_capture``.
        queue_gigabytes: room of the queue of ``every``.
        record: folder for the cameras' own packets; None for none.
        resume: whether the stream is continued.
        denoising: over how many sets frame 0 is averaged.
    """

    policy: Policy = "latest"
    frames: int | None = None
    held_out: tuple[str, ...] | None = None
    scale: float = 1.0
    near: float | None = None
    queue_gigabytes: float = QUEUE_GIGABYTES
    record: Path | None = None
    resume: bool = False
    denoising: DenoisingConfig = field(default_factory=DenoisingConfig)


class LiveSource:
    """Frames of live cameras (docs/live.md). Cameras are opened when the first live frame is asked for.

    Args:
        path: the rig file.
        stream: the stream that is made, beside which pictures wait and are kept (:class:`KeptFrames`).
        options: see :class:`LiveOptions`.
        now: monotonic seconds.
        unix: Unix time, asked once.

    Raises:
        CaptureError: the rig file or the calibration is broken.
        ConfigError: an invalid option.
        StorageError: a folder cannot be used.
    """

    def __init__(
        self,
        path: Path,
        stream: Path,
        options: LiveOptions | None = None,
        *,
        now: Callable[[], float] = time.monotonic,
        unix: Callable[[], float] = time.time,
    ) -> None:
        options = LiveOptions() if options is None else options
        if not options.queue_gigabytes > 0:
            raise ConfigError(f"The queue needs room, got {options.queue_gigabytes:g} gigabytes.")
        rig = read_rig(path)
        calibration = read_calibration(rig.calibration)
        check_cameras(rig, list(calibration.cameras), path)
        self._calibration = chosen_cameras(calibration, list(rig.cameras))
        self._live: LiveRig = rig
        self._options, self._stream, self._now = options, stream, now
        self._unix_offset = unix() - now()
        self.name = rig.name
        self.fps = calibration.fps if rig.fps is None else rig.fps
        self._filmed = filmed_rig(self._calibration, rig.calibration)
        self.rig: CameraRig = self._calibrated(iter(())).rig
        self.points: NDArray[np.float64] | None = None
        self.faults = FaultLog(self.name, now=now)
        self._kept = KeptFrames(kept_folder(stream), cameras=self.rig.training, resume=options.resume)
        self._stopped = threading.Event()
        self._outlet: Outlet | None = None
        self._arrivals: Arrivals | None = None
        self._handed: deque[float] = deque(maxlen=64)
        self._ages: SetAges | None = None
        self._captured: dict[int, float] = {}

    @property
    def newest_only(self) -> bool:
        """See ``ArrivingFrames``."""
        return self._options.policy == "latest"

    def keep(self, *first: int, last: int) -> None:
        """See ``KeepsFrames``."""
        self._kept.need(*first, last=last)

    def stop(self) -> None:
        """The stream ends instead of handing out another frame; may be called from any thread or a signal's handler."""
        self._stopped.set()

    @property
    def stopped(self) -> bool:
        """Whether :meth:`stop` was called."""
        return self._stopped.is_set()

    def frames(self, start: int = 0) -> Iterator[MultiViewFrame]:
        """Kept frames from ``start`` on, if the stream is resumed, then live ones.

        Raises:
            CaptureError: a frame that no camera can send again is not kept.
            StorageError: pictures cannot be written.
        """
        index, most = start, self._options.frames
        for frame in self._kept.following(start) if self._options.resume else ():
            if most is not None and index >= most:
                return
            yield frame
            index = frame.index + 1
        if (most is None or index < most) and not self.stopped:
            yield from self._live_frames(index)

    def captured(self, index: int) -> float | None:
        """When one of the last frames was filmed, Unix time; None if that is not known."""
        return self._captured.get(index)

    def status(self) -> LiveStatus:
        """What cameras and queues do now."""
        handed = [*self._handed]
        rate = (len(handed) - 1) / (handed[-1] - handed[0]) if len(handed) > 1 and handed[-1] > handed[0] else 0.0
        return LiveStatus.of(
            self._arrivals,
            None if self._outlet is None else self._outlet.status,
            faults=self.faults.counts,
            cameras=tuple(self._live.cameras),
            handed_per_second=rate,
            ages=self._ages,
        )

    def __enter__(self) -> "LiveSource":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def _live_frames(self, start: int) -> Iterator[MultiViewFrame]:
        last = self._kept.last() if self._options.resume else None
        pts, origin = (None, None) if last is None else last
        with self._running() as (arrivals, outlet, recording):
            numbered = self._calibrated(self._arriving(arrivals, outlet, complete=start == 0)).frames()
            for index, frame in enumerate(numbered, start):
                seconds = frame.pts_seconds
                origin = self._origin(origin, seconds, pts)
                pts = seconds - origin
                frame = replace(frame, index=index, pts_seconds=pts)
                if index == 0:
                    frame = self._denoised(frame, arrivals, outlet)
                self._kept.keep(frame, origin_seconds=origin)
                if recording is not None:
                    self._note(recording, frame, seconds)
                self._hand(frame, outlet.taken)
                yield frame
                if self._options.frames is not None and index + 1 >= self._options.frames:
                    return

    def _denoised(self, frame: MultiViewFrame, arrivals: Arrivals, outlet: Outlet) -> MultiViewFrame:
        """Frame 0, averaged with the sets after it (``data/denoising.py``)."""
        config, until = self._options.denoising, self._now() + AHEAD_SECONDS

        def following() -> Iterator[MultiViewFrame]:
            number = 0
            while number < config.frames - 1 and not self.stopped and self._now() < until:
                ended = arrivals.ended
                if (found := outlet.ahead(number, POLL_SECONDS)) is not None:
                    number += 1
                    yield found
                elif ended:
                    return

        later = self._calibrated(following()).frames()
        return mean_of_still(frame, later, names=self.rig.training, config=config)

    def _note(self, recording: Recording, frame: MultiViewFrame, seconds: float) -> None:
        try:
            recording.frame(frame, common_seconds=seconds)
        except StorageError as error:  # the stream is worth more than notes on it
            self.faults.say("all", "recording", f"are no longer noted in the recording: {error}")

    def _origin(self, origin: float | None, seconds: float, before: float | None) -> float:
        """The common clock at presentation time 0; it is set anew where it would not let time rise."""
        if origin is None:
            return seconds
        if before is not None and seconds - origin <= before:
            log.warning("%s: the cameras' clock has begun anew; presentation times go on after the last one", self.name)
            return seconds - before - 1 / self.fps
        return origin

    def _hand(self, frame: MultiViewFrame, times: SetTimes | None) -> None:
        now = self._now()
        self._handed.append(now)
        if frame.captured_unix_seconds is not None:
            filmed = frame.captured_unix_seconds - self._unix_offset
            arrived, matched = (None, None) if times is None else (times.arrived - filmed, times.matched - filmed)
            self._ages = SetAges(arrived, matched, now - filmed)
            self._captured[frame.index] = frame.captured_unix_seconds
            self._captured.pop(frame.index - LATEST_KNOWN, None)

    def _calibrated(self, arrived: Iterator[MultiViewFrame]) -> FrameSource:
        options = self._options
        arriving = Arriving(self.name, self._filmed, self.fps, arrived)
        return as_calibrated(
            arriving,
            self._calibration,
            self._live.calibration,
            held_out=options.held_out,
            scale=options.scale,
            near=options.near,
        )

    def _arriving(self, arrivals: Arrivals, outlet: Outlet, *, complete: bool) -> Iterator[MultiViewFrame]:
        """Frames as they are filmed, at the common clock's times; with ``complete`` the first waits for all cameras."""
        begun = told = self._now()
        quiet = HEARTBEAT_SECONDS
        while not self.stopped:
            ended, coming = arrivals.ended, arrivals.coming  # asked before, so that a set put in between is not lost
            frame = outlet.take(POLL_SECONDS)
            now = self._now()
            if frame is None:
                if ended and complete:
                    raise CaptureError(
                        f"{self.name} has no frame: {ended}. Frame 0 needs pictures of {MIN_CAMERAS} training "
                        "cameras of one instant; the warnings before this say what is wrong with each camera."
                    )
                if ended:
                    log.warning("%s: %s", self.name, ended)
                    return
                if now - told > quiet:
                    told, quiet = now, 2 * quiet
                    log.warning("%s: no set of pictures yet; %s", self.name, arrivals.waiting_for())
                continue
            told, quiet = now, HEARTBEAT_SECONDS
            absent = [name for name in self._filmed if name not in frame.images]
            if complete and now - begun < self._live.start_seconds and {*absent} & {*coming}:
                continue
            if len(frame.showing(self.rig.training)) < MIN_CAMERAS:
                arrivals.count_small()
                continue
            if complete and absent:
                missing = ", ".join(absent)
                log.warning("%s: frame 0 has no picture of %s, so what only they see is missing", self.name, missing)
            complete = False
            yield frame

    @contextmanager
    def _running(self) -> Iterator[tuple[Arrivals, Outlet, Recording | None]]:
        recording = None
        if self._options.record is not None:
            recording = Recording(self._options.record, self._calibration, fps=self.fps, unit_name=self.name)
        outlet = self._outlet = self._made_outlet()
        arrivals = self._arrivals = Arrivals(
            self._live,
            sizes=filmed_sizes(self._calibration),
            fps=self.fps,
            faults=self.faults,
            outlet=outlet,
            recording=recording,
            now=self._now,
            unix_offset=self._unix_offset,
        )
        try:
            arrivals.start()
            yield arrivals, outlet, recording
        finally:
            arrivals.stop()
            outlet.close()
            if recording is not None:
                recording.close()

    def _made_outlet(self) -> Outlet:
        if self._options.policy == "latest":
            return Latest(self._converted())
        most = round(self._options.queue_gigabytes * GIGABYTE)
        folder = self._stream.with_name(f"{self._stream.name}.queue")
        return DiskQueue(folder, max_bytes=most, convert=self._converted(), resume=self._options.resume)

    def _converted(self) -> Convert:
        """What makes a set a frame; a camera whose colours cannot be converted is absent from it."""
        reformatter = load_av().video.reformatter.VideoReformatter()
        sizes: Mapping[str, tuple[int, int]] = filmed_sizes(self._calibration)

        def convert(found: PictureSet) -> MultiViewFrame:
            images = {}
            for name, picture in found.pictures.items():
                try:
                    images[name] = srgb(picture.content, reformatter, width=sizes[name][0], height=sizes[name][1])
                except (load_av().error.FFmpegError, ValueError) as error:
                    text = f"sends pictures whose colours cannot be converted ({error}); it is absent"
                    self.faults.tell(name, Fault.GARBAGE, text)
            first = min(found.pictures.values(), key=lambda picture: picture.arrived)
            streamed = self._live.clock is TimeBase.STREAM  # a clock of its own, which tells nothing of Unix time
            captured = first.arrived + self._unix_offset if streamed else found.seconds
            return MultiViewFrame(0, found.seconds, images, captured_unix_seconds=captured)

        return convert

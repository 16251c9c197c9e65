# SPDX-License-Identifier: Apache-2.0
"""Live cameras as a stream of frames of unknown length, with the calibration of a capture."""

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from structgstream.cameras import CameraRig
from structgstream.data.denoising import DenoisingConfig, mean_of_still
from structgstream.data.lenses import LensCamera, Pinhole
from structgstream.data.live.ingest import Ingest
from structgstream.data.live.recorder import Recording
from structgstream.data.live.resume_cache import ResumeCache, resume_folder
from structgstream.data.live.rig_file import LiveRig, TimeBase, check_cameras, read_rig
from structgstream.data.live.status import CameraStatus, Fault, FaultLog, LiveStatus
from structgstream.data.live.synchronizer import PictureSet
from structgstream.data.masks import masks_folder, with_masks
from structgstream.data.open import open_capture, selected
from structgstream.data.prepared import (
    PreparedCamera,
    PreparedCapture,
    filmed_rig,
    read_prepared,
    recognizes_prepared,
    undistorted,
)
from structgstream.data.sound import LiveSound
from structgstream.data.source import FrameSource
from structgstream.data.undistortion import lenses_of
from structgstream.data.video import srgb
from structgstream.data.video_index import load_av
from structgstream.errors import CaptureError, ConfigError, StorageError
from structgstream.frames import MIN_CAMERAS, MultiViewFrame


@dataclass(frozen=True)
class LivePictures:
    """Pictures as cameras sent them, as a capture, so that the wrappers of captures apply to them."""

    name: str  # of the stream
    rig: CameraRig  # the cameras of the stored pictures
    fps: float  # frames a second
    arriving: Iterator[MultiViewFrame]  # frames in the order of their arrival
    points: NDArray | None = None

    def __len__(self) -> int:
        """0: the number is unknown."""
        return 0

    def frames(self, start: int = 0) -> Iterator[MultiViewFrame]:
        return self.arriving


def read_calibration(folder: Path) -> PreparedCapture:
    """Lenses and pinholes of the cameras of a capture of any layout; of a prepared one ``capture.json`` is all that is
    needed."""
    if recognizes_prepared(folder):
        return read_prepared(folder)
    source = open_capture(folder)
    lenses = lenses_of(source) or {}
    rig = source.rig
    cameras = {
        name: PreparedCamera(name, lenses.get(name, LensCamera(rig[name], Pinhole())), rig[name]) for name in rig
    }
    near = min(rig[name].near for name in rig)
    return PreparedCapture(cameras, source.fps, near, "arbitrary", rig.held_out)


log = logging.getLogger(__name__)

POLL_SECONDS = 0.2
HEARTBEAT_SECONDS = 5.0
MAX_DENOISING_SECONDS = 5.0  # for the sets that frame 0 is averaged with
MAX_CAPTURE_TIMES = 16  # of the last frames


@dataclass(frozen=True)
class LiveOptions:
    """Options of a live run."""

    frames: int | None = None  # number of frames after which the stream ends; None for no end
    held_out: tuple[str, ...] | None = None  # see ``open_capture``
    scale: float = 1.0  # see ``open_capture``
    near: float | None = None  # see ``open_capture``
    record: Path | None = None  # folder for the cameras' packets; None for none
    resume: bool = False  # whether the stream is continued
    sound: str | None = None  # the camera whose sound is stored; None for none
    denoising: DenoisingConfig = field(default_factory=DenoisingConfig)  # over how many sets frame 0 is averaged


class LiveSource:
    """Frames of live cameras (docs/live.md). Cameras are opened when the first live frame is asked for. The resume
    cache (:class:`ResumeCache`) lies next to ``stream``, the stream to write.

    Raises:
        CaptureError: the rig file or the calibration is broken; while reading, a frame of the past is not cached.
        ConfigError: an invalid option.
        StorageError: a folder cannot be used, or pictures cannot be written.
    """

    def __init__(self, path: Path, stream: Path, options: LiveOptions = LiveOptions()) -> None:
        rig = read_rig(path)
        calibration = read_calibration(rig.calibration)
        check_cameras(rig, list(calibration.cameras), path)
        self._calibration = calibration.only(rig.cameras)
        if options.sound is not None and options.sound not in rig.cameras:
            raise ConfigError(
                f"{path} has no camera {options.sound!r} whose sound could be stored; it has {', '.join(rig.cameras)}."
            )
        self.sound = None if options.sound is None else LiveSound(options.sound)
        self._live: LiveRig = rig
        self._options = options
        self._unix_offset = time.time() - time.monotonic()
        self.name = rig.name
        self.fps = calibration.fps if rig.fps is None else rig.fps
        self._filmed = filmed_rig(rig.calibration, self._calibration)
        self._sizes = {name: (camera.width, camera.height) for name, camera in self._filmed.cameras.items()}
        self._reformatter = load_av().video.reformatter.VideoReformatter()
        self.rig: CameraRig = self._calibrated(iter(())).rig
        self.points: NDArray[np.float64] | None = None
        self.faults = FaultLog(self.name, now=time.monotonic)
        self._cache = ResumeCache(resume_folder(stream), cameras=self.rig.training, resume=options.resume)
        self.stopped = False
        self._ingest: Ingest | None = None
        self._small_sets = 0
        self._times = 0.0, 0.0  # of the last set: when its last picture arrived, and when it was complete
        self._ages: dict[str, float] = {}
        self._captured: dict[int, float] = {}

    def retain(self, *first: int, last: int) -> None:
        """See ``RetainsFrames``."""
        self._cache.retain(*first, last=last)

    def stop(self) -> None:
        """Ends the stream before the next frame; may be called from any thread or a signal's handler."""
        self.stopped = True

    def frames(self, start: int = 0) -> Iterator[MultiViewFrame]:
        """If the stream is resumed, the cached frames from ``start`` on; then live ones."""
        index, end = start, self._options.frames
        for frame in self._cache.frames(start) if self._options.resume else ():
            if end is not None and index >= end:
                return
            yield frame
            index = frame.index + 1
        if (end is None or index < end) and not self.stopped:
            yield from self._live_frames(index)

    def captured(self, index: int) -> float | None:
        """When one of the last frames was captured, Unix time; None if unknown."""
        return self._captured.get(index)

    def status(self) -> LiveStatus:
        """State of cameras and synchronisation."""
        faults, ingest = self.faults.counts, self._ingest
        if ingest is None:  # cameras have not been opened yet
            return LiveStatus({name: CameraStatus() for name in self._live.cameras})
        present, lengths = ingest.present, ingest.queue_lengths
        return LiveStatus(
            {
                name: CameraStatus(name in present, feed.decoded, lengths[name], faults.get(name, {}))
                for name, feed in ingest.feeds.items()
            },
            sets=ingest.sets,
            small_sets=self._small_sets,
            skipped_sets=ingest.skipped_sets,
            **self._ages,
        )

    def __enter__(self) -> "LiveSource":
        return self

    def __exit__(self, *raised: object) -> None:
        self.stop()

    def _live_frames(self, start: int) -> Iterator[MultiViewFrame]:
        pts, origin = (self._cache.last() if self._options.resume else None) or (None, None)
        with self._running() as (ingest, recording):
            frames = self._calibrated(self._arriving(ingest, start)).frames()
            for index, frame in enumerate(frames, start):
                times, seconds = self._times, frame.pts_seconds
                origin = self._origin(origin, seconds, pts)
                pts = seconds - origin
                if self.sound is not None:
                    self.sound.synchronize(origin)
                frame = replace(frame, index=index, pts_seconds=pts)
                if index == 0:
                    frame = self._denoised(frame, ingest)
                self._cache.store(frame, origin_seconds=origin)
                if recording is not None:
                    self._record_frame(recording, frame, seconds)
                self._measure_delivery(frame, times)
                yield frame
                if self._options.frames is not None and index + 1 >= self._options.frames:
                    return

    def _denoised(self, frame: MultiViewFrame, ingest: Ingest) -> MultiViewFrame:
        """Frame 0, averaged with the sets after it (``data/denoising.py``)."""
        config, deadline = self._options.denoising, time.monotonic() + MAX_DENOISING_SECONDS

        def following() -> Iterator[MultiViewFrame]:
            while not self.stopped and time.monotonic() < deadline:
                ended = ingest.end_reason
                if (found := self._taken(ingest)) is not None:
                    yield found
                elif ended:
                    return

        later = self._calibrated(following()).frames()
        return mean_of_still(frame, later, names=self.rig.training, config=config)

    def _record_frame(self, recording: Recording, frame: MultiViewFrame, seconds: float) -> None:
        try:
            recording.add_frame(frame, common_seconds=seconds)
        except StorageError as error:  # the stream goes on
            self.faults.warn("all", "recording", f"are no longer listed in the recording: {error}")

    def _origin(self, origin: float | None, seconds: float, before: float | None) -> float:
        """The common clock at presentation time 0; reset where presentation times would not increase."""
        if origin is None:
            return seconds
        if before is not None and seconds - origin <= before:
            log.warning("%s: the cameras' clock was reset; presentation times continue after the last one", self.name)
            return seconds - before - 1 / self.fps
        return origin

    def _measure_delivery(self, frame: MultiViewFrame, times: tuple[float, float]) -> None:
        assert frame.captured_unix_seconds is not None
        captured = frame.captured_unix_seconds - self._unix_offset
        self._ages = {
            "arrived_seconds": times[0] - captured,
            "matched_seconds": times[1] - captured,
            "delay_seconds": time.monotonic() - captured,
        }
        self._captured[frame.index] = frame.captured_unix_seconds
        self._captured.pop(frame.index - MAX_CAPTURE_TIMES, None)

    def _calibrated(self, arriving: Iterator[MultiViewFrame]) -> FrameSource:
        """Pictures as they arrive, undistorted and masked as those of the calibration's capture are."""
        options, folder = self._options, self._live.calibration
        pictures = undistorted(LivePictures(self.name, self._filmed, self.fps, arriving), folder, self._calibration)
        source = with_masks(pictures, masks_folder(folder), without=self._live.without)
        return selected(source, held_out=options.held_out, scale=options.scale, near=options.near)

    def _arriving(self, ingest: Ingest, start: int) -> Iterator[MultiViewFrame]:
        """Frames ``start`` and later before undistortion, at times of the common clock; the first waits for all
        cameras."""
        started = reported = time.monotonic()
        is_first = True
        interval = HEARTBEAT_SECONDS
        while not self.stopped:
            # Asked before the frame, so that a set that arrives in between is not lost.
            ended, sending = ingest.end_reason, ingest.open_cameras
            frame = self._taken(ingest)
            now = time.monotonic()
            if frame is None:
                if ended and is_first and start == 0:
                    raise CaptureError(
                        f"{self.name} has no frame: {ended}. Frame 0 needs pictures of {MIN_CAMERAS} training "
                        "cameras of one instant; the warnings before this say what is wrong with each camera."
                    )
                if ended:
                    log.warning("%s: %s", self.name, ended)
                    return
                if now - reported > interval:
                    reported, interval = now, 2 * interval
                    log.warning("%s: no set of pictures yet; %s", self.name, ingest.describe_absent())
                continue
            reported, interval = now, HEARTBEAT_SECONDS
            absent = [name for name in self._filmed if name not in frame.images]
            if is_first and now - started < self._live.start_seconds and {*absent} & {*sending}:
                continue
            if len(frame.showing(self.rig.training)) < MIN_CAMERAS:
                self._small_sets += 1
                continue
            if is_first and absent and start == 0:
                missing = ", ".join(absent)
                log.warning("%s: frame 0 has no picture of %s, so what only they see is missing", self.name, missing)
            is_first = False
            yield frame

    @contextmanager
    def _running(self) -> Iterator[tuple[Ingest, Recording | None]]:
        recording = None
        if self._options.record is not None:
            masks = masks_folder(self._live.calibration)
            recording = Recording(self._options.record, self._calibration, fps=self.fps, masks=masks)
        ingest = self._ingest = Ingest(
            self._live,
            sizes=self._sizes,
            fps=self.fps,
            faults=self.faults,
            recording=recording,
            now=time.monotonic,
            unix_offset=self._unix_offset,
            sound=self.sound,
        )
        try:
            ingest.start()
            yield ingest, recording
        finally:
            ingest.stop()
            if recording is not None:
                recording.close()

    def _taken(self, ingest: Ingest) -> MultiViewFrame | None:
        """The frame of the newest set; None if there was none for a moment."""
        found = ingest.take(POLL_SECONDS)
        if found is None:
            return None
        self._times = found.arrived, found.matched
        return self._converted(found)

    def _converted(self, found: PictureSet) -> MultiViewFrame:
        """The sRGB pictures of a set, at its time; a camera whose colours cannot be converted is absent."""
        images = {}
        for name, picture in found.pictures.items():
            width, height = self._sizes[name]
            try:
                images[name] = srgb(picture.content, self._reformatter, width=width, height=height)
            except (load_av().error.FFmpegError, ValueError) as error:
                text = f"sends pictures whose colours cannot be converted ({error}); it is absent"
                self.faults.report(name, Fault.GARBAGE, text)
        first = min(found.pictures.values(), key=lambda picture: picture.arrived)
        is_relative = self._live.clock is TimeBase.STREAM  # the cameras' clock need not be Unix time
        captured = first.arrived + self._unix_offset if is_relative else found.seconds
        return MultiViewFrame(0, found.seconds, images, captured_unix_seconds=captured)

# SPDX-License-Identifier: Apache-2.0
"""Captures with one video per camera, synchronised by time stamp."""

import logging
import os
from collections.abc import Generator, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from structgstream.cameras import CameraRig
from structgstream.data.timeline import Clock, Placed, common_slots, log_time_error, measured_rate, origin_of, place
from structgstream.data.video_index import STREAM_FORMATS, VideoTrack
from structgstream.data.video_pictures import Mask, Picture, pictures_at
from structgstream.errors import CalibrationError, CaptureError
from structgstream.frames import MultiViewFrame

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class VideoSource:
    """A :class:`~structgstream.data.source.FrameSource` over one video per camera, made by :func:`synchronised`.

    Pictures are converted to the size that ``rig`` states.
    """

    name: str  # the capture's name
    rig: CameraRig  # its cameras
    fps: float  # frames a second
    tracks: Mapping[str, VideoTrack]  # camera name to its video
    stamps: Mapping[str, tuple[int | None, ...]]
    """Camera name to the time stamp, in ticks of its video, of its picture in each frame; None where it has none."""
    points: NDArray[np.float64] | None = None  # ``[P, 3]`` points that came with the capture, or None
    apart_seconds: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    """Camera name to how long after its instant its picture of each frame was taken, ``[N]`` by its own time stamps;
    NaN where it has none."""
    _reported: set[str] = field(default_factory=set, init=False, repr=False, compare=False)

    def __len__(self) -> int:
        return min(len(stamps) for stamps in self.stamps.values())

    def frames(self, start: int = 0) -> Iterator[MultiViewFrame]:
        """The frames from stream index ``start``: an exact seek, then the cameras in lockstep.

        Where a video cannot be decoded its camera is absent, with one warning (``video_pictures``, Note [Damaged
        videos]).

        Raises:
            CaptureError: a video was moved or replaced.
        """
        with ExitStack() as stack:
            decoders = [stack.enter_context(closing(self._pictures(name, start))) for name in self.rig]
            # Entered last, so that no thread is inside a decoder when the decoders close.
            pool = stack.enter_context(ThreadPoolExecutor(min(len(self.rig), os.cpu_count() or 1), "videos"))
            for index in range(start, len(self)):
                pictures = zip(self.rig, pool.map(_next, decoders), strict=True)
                present = {name: shown for name, shown in pictures if shown is not None}
                images = {name: picture for name, (picture, _) in present.items()}
                masks = {name: mask for name, (_, mask) in present.items() if mask is not None}
                yield MultiViewFrame(index, index / self.fps, images, masks=masks)

    def resized(self, rig: CameraRig) -> "VideoSource":
        """The same frames at the sizes of ``rig``, resampled by area while the colours are converted."""
        return replace(self, rig=rig)

    def _pictures(self, name: str, start: int) -> Generator[tuple[Picture, Mask | None] | None]:
        track, camera = self.tracks[name], self.rig[name]

        def report(lost: int, following: int | None, reason: str) -> None:
            if name in self._reported:
                return
            self._reported.add(name)
            until = "the end" if following is None else f"{following * track.tick_seconds:.3f} s"
            log.warning(
                "%s: the video %s of camera %r cannot be decoded at %.3f s (%s); the camera is absent until %s, and "
                "wherever that happens again",
                self.name, track.path, name, lost * track.tick_seconds, reason, until,
            )  # fmt: skip

        return pictures_at(track, self.stamps[name][start:], size=(camera.width, camera.height), on_damage=report)


def _next(pictures: Iterator[tuple[Picture, Mask | None] | None]) -> tuple[Picture, Mask | None] | None:
    return next(pictures)


def synchronised(
    tracks: Mapping[str, VideoTrack],
    rig: CameraRig,
    *,
    where: Path,
    fps: float | None = None,
    points: NDArray[np.float64] | None = None,
    clocks: Mapping[str, Clock] | None = None,
) -> VideoSource:
    """One source from one video per camera, synchronised by time stamp on a common timeline.

    Each instant takes the nearest frame of each camera within half a period (``timeline``), so rates may differ or
    vary; a camera without one is absent. Of different rates the lowest is taken.

    Args:
        tracks: camera name to its video.
        rig: the same cameras.
        where: the capture, for messages and for its name.
        fps: frames a second; measured from the time stamps when None.
        points: passed on to the source.
        clocks: camera name to its clock; None if time stamps are of one clock, are taken at the rate ``fps`` if that
            is given, and no camera has two frames for one instant.

    Raises:
        CalibrationError: a video's size is not the size that its camera's intrinsics are for.
        CaptureError: two frames for one instant or another rate than ``fps``, both without clocks, or no frames in
            common.
    """
    for name in rig:
        track, camera = tracks[name], rig[name]
        if (track.width, track.height) != (camera.width, camera.height):
            raise CalibrationError(
                f"The video {track.path} has {track.width}x{track.height} pixels, the intrinsics of "
                f"camera {name!r} are for {camera.width}x{camera.height}; scale the intrinsics, "
                "or use the video that was calibrated."
            )
    times = _common_times(tracks, clocks)
    measured = measured_fps(tracks, clocks)
    if fps is not None and clocks is None and measured is not None and abs(measured / fps - 1) > 0.02:
        raise CaptureError(
            f"{where} states {fps:g} frames a second, the time stamps of its videos say {measured:g}; "
            "correct the number."
        )
    rate = fps or measured or 30.0  # one frame per camera: any rate is right
    positions = {name: times[name] * rate for name in rig}
    origin = origin_of(list(positions.values()))
    placed = {name: place(own - origin) for name, own in positions.items()}
    common = common_slots(
        {name: _slots(own, keep_repeated=clocks is None) for name, own in placed.items()},
        where=str(where),
        label=lambda slot: f"the instant {(origin + slot) / rate:.3f} s",
        training=rig.training,
    )
    log_time_error(placed, common, fps=rate, where=str(where))
    stamps = {name: _stamps(tracks[name], own, common) for name, own in placed.items()}
    errors = {name: _errors(own, common) / rate for name, own in placed.items()}
    return VideoSource(where.name, rig, rate, tracks, stamps, points, errors)


def measured_fps(tracks: Mapping[str, VideoTrack], clocks: Mapping[str, Clock] | None = None) -> float | None:
    """Frames a second of the common timeline by time stamp (``timeline.measured_rate``); None for one frame.

    Raises:
        CaptureError: the frames of a video all have one time.
    """
    for track in tracks.values():
        if len(track.stamps) > 1 and track.stamps[-1] == track.stamps[0]:
            raise CaptureError(
                f"The {len(track.stamps)} frames of the video {track.path} all have the same time stamp, so they "
                "cannot be matched with other cameras; write it again with the time of each frame."
            )
    return measured_rate([*_common_times(tracks, clocks).values()])


def _common_times(
    tracks: Mapping[str, VideoTrack], clocks: Mapping[str, Clock] | None
) -> dict[str, NDArray[np.float64]]:
    """The frames' times of each video on the common clock, seconds.

    Without clocks, and where containers differ, videos in containers for transmission begin at 0 as the others do:
    FFmpeg writes the first picture of an MPEG transport stream at 1.4 s.
    """
    if clocks is not None:
        return {name: clocks.get(name, Clock()).common_seconds(track.seconds) for name, track in tracks.items()}
    is_mixed = len({track.container for track in tracks.values()}) > 1
    starts = {
        name: track.start if is_mixed and track.container in STREAM_FORMATS else 0 for name, track in tracks.items()
    }
    return {name: track.seconds - starts[name] * track.tick_seconds for name, track in tracks.items()}


def _slots(placed: Placed, *, keep_repeated: bool) -> list[int]:
    """The slots that have a frame, ascending; those that two frames compete for are repeated if wanted."""
    return sorted([*placed.slots.tolist(), *(placed.repeated if keep_repeated else ())])


def _stamps(track: VideoTrack, placed: Placed, common: range) -> tuple[int | None, ...]:
    """The time stamp of each slot of the range; None for those without a frame."""
    frame_of = dict(zip(placed.slots.tolist(), placed.frames.tolist(), strict=True))
    return tuple(track.stamps[frame_of[slot]] if slot in frame_of else None for slot in common)


def _errors(placed: Placed, common: range) -> NDArray[np.float64]:
    """Time of the frame of each slot of the range minus the slot's instant, in periods; NaN for those without one."""
    errors = np.full(len(common), np.nan)
    inside = (placed.slots >= common.start) & (placed.slots < common.stop)
    errors[placed.slots[inside] - common.start] = placed.errors[inside]
    return errors

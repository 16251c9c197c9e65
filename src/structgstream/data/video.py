# SPDX-License-Identifier: Apache-2.0
"""Captures with one video per camera, synchronised by time stamp. The only module that reads video."""

import os
from collections.abc import Generator, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from structgstream.cameras import Camera, CameraRig
from structgstream.data.timeline import common_slots
from structgstream.errors import CalibrationError, CaptureError, MissingExtraError
from structgstream.frames import MultiViewFrame

if TYPE_CHECKING:
    from av.container import InputContainer
    from av.video.frame import VideoFrame
    from av.video.reformatter import VideoReformatter

# Containers that store presentation times; AVI does not.
VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".mkv", ".webm", ".m4v", ".ts"})
TOLERANCE_IN_PERIODS = 0.4  # closer to half a period, the time step of a frame would be ambiguous
STANDARD_RATES = tuple(rate * factor for rate in (24, 25, 30, 50, 60, 120) for factor in (1.0, 1000 / 1001))

# Values of libswscale and of ISO/IEC 23091-2 that the bindings name differently from version to version.
AREA, BICUBIC, FULL_CHROMA, ACCURATE_ROUNDING = 0x20, 0x4, 0x2000, 0x40000
BT709, BT601, FULL_RANGE, LIMITED_RANGE = 1, 5, 2, 1
MATRICES = {1: BT709, 4: 4, 5: BT601, 6: BT601, 7: 7, 9: 9, 10: 9}


@dataclass(frozen=True)
class VideoTrack:
    """The index of a video file.

    Args:
        path: the file.
        stamps: presentation time of every frame to use, ascending, in ticks.
        tick_seconds: length of a tick.
        width: stored picture width, pixels.
        height: stored picture height, pixels.
    """

    path: Path
    stamps: tuple[int, ...]
    tick_seconds: float
    width: int
    height: int


@dataclass(frozen=True)
class VideoSource:
    """A :class:`~structgstream.data.source.FrameSource` over one video per camera.

    Made by :func:`synchronised`; ``tracks`` hold only the frames that all cameras have. Pictures are
    converted to the size that ``rig`` states.
    """

    name: str
    rig: CameraRig
    fps: float
    tracks: Mapping[str, VideoTrack]
    points: NDArray[np.float64] | None = None

    def __len__(self) -> int:
        return min(len(track.stamps) for track in self.tracks.values())

    def frames(self, start: int = 0) -> Iterator[MultiViewFrame]:
        """The frames from stream index ``start``: an exact seek, then the cameras in lockstep.

        Raises:
            CaptureError: a video cannot be decoded, or ends before its index says.
        """
        with ExitStack() as stack:
            decoders = [_decoded(self.tracks[name], self.rig[name], start) for name in self.rig]
            for decoder in decoders:
                stack.enter_context(closing(decoder))
            # Entered last, so that no thread is inside a decoder when the decoders close.
            pool = stack.enter_context(ThreadPoolExecutor(min(len(self.rig), os.cpu_count() or 1), "videos"))
            for index in range(start, len(self)):
                pictures = pool.map(next, decoders)
                yield MultiViewFrame(index, index / self.fps, dict(zip(self.rig, pictures, strict=True)))

    def resized(self, rig: CameraRig) -> "VideoSource":
        """The same frames at the sizes of ``rig``, resampled by area while the colours are converted."""
        return replace(self, rig=rig)


def scan_videos(paths: Mapping[str, Path]) -> dict[str, VideoTrack]:
    """The index of every video, read without decoding.

    Raises:
        CaptureError: a file is missing, truncated, or not a video.
    """
    with ThreadPoolExecutor(min(len(paths), os.cpu_count() or 1) or 1) as pool:
        return dict(zip(paths, pool.map(_scan, paths.values()), strict=True))


def synchronised(
    tracks: Mapping[str, VideoTrack],
    rig: CameraRig,
    *,
    where: Path,
    fps: float | None = None,
    points: NDArray[np.float64] | None = None,
) -> VideoSource:
    """One source from one video per camera, synchronised by time stamp on a common timeline.

    Args:
        tracks: camera name to its video.
        rig: the same cameras.
        where: the capture, for messages and for its name.
        fps: frames a second; measured from the time stamps when None.
        points: passed on to the source.

    Raises:
        CalibrationError: a video's size is not the size that its camera's intrinsics are for.
        CaptureError: a missing or duplicate frame, a time stamp between two instants, another rate than
            ``fps``, or no frames in common.
    """
    for name in rig:
        track, camera = tracks[name], rig[name]
        if (track.width, track.height) != (camera.width, camera.height):
            raise CalibrationError(
                f"The video {track.path} has {track.width}x{track.height} pixels, the intrinsics of "
                f"camera {name!r} are for {camera.width}x{camera.height}; scale the intrinsics, "
                "or use the video that was calibrated."
            )
    measured = measured_fps(tracks)
    if fps is not None and measured is not None and abs(measured / fps - 1) > 0.02:
        raise CaptureError(
            f"{where} states {fps:g} frames a second, the time stamps of its videos say {measured:g}; "
            "correct the number."
        )
    rate = fps or measured or 30.0  # one frame per camera: any rate is right
    slots, origin_seconds = _slots(tracks, rate, where=where)
    common = common_slots(
        slots, where=str(where), label=lambda slot: f"the instant {origin_seconds + slot / rate:.3f} s"
    )
    cut = {}
    for name in rig:
        first = slots[name].index(common.start)
        cut[name] = replace(tracks[name], stamps=tracks[name].stamps[first : first + len(common)])
    return VideoSource(where.name, rig, rate, cut, points)


def measured_fps(tracks: Mapping[str, VideoTrack]) -> float | None:
    """Frames a second by time stamp: robust to missing frames, exact for usual rates, None for one frame.

    Raises:
        CaptureError: the frames of a video all have one time.
    """
    rates = []
    for track in tracks.values():
        if len(track.stamps) < 2:
            continue
        if track.stamps[-1] == track.stamps[0]:
            raise CaptureError(
                f"The {len(track.stamps)} frames of the video {track.path} all have the same time stamp, so they "
                "cannot be matched with other cameras; write it again with the time of each frame."
            )
        steps = np.diff(track.stamps)
        frames = np.rint(steps / max(float(np.median(steps)), 1.0)).sum()
        rates.append(float(frames) / ((track.stamps[-1] - track.stamps[0]) * track.tick_seconds))
    if not rates:
        return None
    rate = float(np.median(rates))
    usual = min(STANDARD_RATES, key=lambda standard: abs(standard - rate))
    return usual if abs(usual / rate - 1) < 3e-4 else rate


def _slots(tracks: Mapping[str, VideoTrack], fps: float, *, where: Path) -> tuple[dict[str, list[int]], float]:
    """Each frame's slot on the common timeline, and the time of slot 0 in seconds."""
    positions = {name: np.array(track.stamps) * (track.tick_seconds * fps) for name, track in tracks.items()}
    origin = min(float(own[0]) for own in positions.values())
    phases = [float(own[0] - origin - np.rint(own[0] - origin)) for own in positions.values()]
    origin += float(np.median(phases))
    slots = {}
    for name, own in positions.items():
        nearest = np.rint(own - origin)
        off = np.abs(own - origin - nearest)
        worst = int(off.argmax())
        if off[worst] > TOLERANCE_IN_PERIODS:
            raise CaptureError(
                f"Camera {name!r} of {where} has a frame at {own[worst] / fps:.4f} s, {off[worst]:.2f} frame "
                f"periods off the common timeline of {fps:.3f} frames a second; expected synchronised "
                "cameras of one rate."
            )
        slots[name] = [int(slot) for slot in nearest]
    return slots, origin / fps


def _av() -> ModuleType:
    """The module ``av``, from the extra ``capture``."""
    try:
        import av
    except ImportError:
        raise MissingExtraError("av", "capture") from None
    return av


def _open(path: Path) -> "InputContainer":
    av = _av()
    try:
        container = av.open(str(path))
    except FileNotFoundError:
        raise CaptureError(f"The video {path} is missing; restore the file.") from None
    except (av.error.FFmpegError, OSError) as error:
        raise CaptureError(
            f"The video {path} cannot be opened ({error.strerror}): it is truncated, damaged or not a video; "
            "copy or record it again."
        ) from None
    if not container.streams.video:
        container.close()
        raise CaptureError(f"The file {path} has no video stream; expected one video per camera.")
    return container


def _scan(path: Path) -> VideoTrack:
    """Reads all packets of a file for their time stamps, and checks that none is missing."""
    av = _av()
    with _open(path) as container:
        stream = container.streams.video[0]
        try:
            packets = [packet for packet in container.demux(stream) if packet.size]
        except av.error.FFmpegError as error:
            raise CaptureError(f"The video {path} is damaged ({error.strerror}); copy or record it again.") from None
        if not packets or any(packet.is_corrupt for packet in packets) or len(packets) < stream.frames:
            raise CaptureError(
                f"The video {path} is truncated: its index announces {stream.frames or 'some'} frames, "
                f"{sum(not packet.is_corrupt for packet in packets)} are there; copy or record it again."
            )
        shown = [packet.pts for packet in packets if not packet.is_discard]
        stamps = [stamp for stamp in shown if stamp is not None]
        if len(stamps) != len(shown) or stream.time_base is None:
            raise CaptureError(
                f"The video {path} has frames without time stamps, so it cannot be synchronised; "
                "remux it to a container that stores them (mp4, mkv)."
            )
        return VideoTrack(path, tuple(sorted(stamps)), float(stream.time_base), stream.width, stream.height)


def _decoded(track: VideoTrack, camera: Camera, start: int) -> Generator[NDArray[np.uint8]]:
    """The pictures of a track from its frame ``start``, each ``[H, W, 3]`` sRGB at the size of ``camera``."""
    if start >= len(track.stamps):
        return
    av = _av()
    reformatter = av.video.reformatter.VideoReformatter()
    wanted, reason = start, "a frame is missing or broken"
    for seek in (True, False) if start else (False,):
        with _open(track.path) as container:
            stream = container.streams.video[0]
            stream.codec_context.thread_count = 1  # the cameras are the parallelism
            try:
                if seek:
                    container.seek(track.stamps[start], stream=stream, backward=True)
                for frame in container.decode(stream):
                    if frame.pts is None or frame.pts < track.stamps[wanted]:
                        continue  # before the exact frame of a seek, or cut from the common range
                    if frame.pts > track.stamps[wanted] or frame.is_corrupt:
                        break
                    yield _srgb(frame, reformatter, width=camera.width, height=camera.height)
                    wanted += 1
                    if wanted == len(track.stamps):
                        return
            except av.error.FFmpegError as error:
                reason = str(error.strerror)
        if wanted > start:
            break
        # Without an index (MPEG-TS) a seek may land after the frame; then decode from the beginning.
    raise CaptureError(_damage(track, wanted, reason))


def _damage(track: VideoTrack, wanted: int, reason: str) -> str:
    seconds = track.stamps[wanted] * track.tick_seconds
    return (
        f"The video {track.path} cannot be decoded at {seconds:.3f} s ({reason}): truncated or damaged; "
        "copy or record it again."
    )


def _srgb(frame: "VideoFrame", reformatter: "VideoReformatter", *, width: int, height: int) -> NDArray[np.uint8]:
    """Colours by the frame's own matrix and range, stated because the defaults differ between tools.

    A file that states no matrix gets BT.709 from 720 lines on and BT.601 below, as broadcasting has it; one
    that states no range is taken as limited unless its pixel format says otherwise.
    """
    matrix = MATRICES.get(int(frame.colorspace), BT709 if frame.height >= 720 else BT601)
    source_range = int(frame.color_range)
    if source_range not in (FULL_RANGE, LIMITED_RANGE):
        full = frame.format.name.startswith(("yuvj", "rgb", "bgr", "gbr"))
        source_range = FULL_RANGE if full else LIMITED_RANGE
    shrinks = width < frame.width or height < frame.height
    converted = reformatter.reformat(
        frame,
        width=width,
        height=height,
        format="rgb24",
        src_colorspace=matrix,
        dst_colorspace=matrix,
        src_color_range=source_range,
        dst_color_range=FULL_RANGE,
        interpolation=(AREA if shrinks else BICUBIC) | FULL_CHROMA | ACCURATE_ROUNDING,
        threads=1,
    )
    return cast(NDArray[np.uint8], converted.to_ndarray())

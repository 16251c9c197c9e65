# SPDX-License-Identifier: Apache-2.0
"""Captures with one video per camera, synchronised by time stamp, and the pictures of a video at given time stamps.

Note [Damaged videos]
~~~~~~~~~~~~~~~~~~~~~
A frame counts as decodable if all frames from the key frame before it on are. So what is lost does not depend on where
reading starts, and a resumed stream sees what the first run saw. After damage, reading continues at the next key frame
that decodes alone.

Note [High dynamic range]
~~~~~~~~~~~~~~~~~~~~~~~~~
HLG and PQ (ITU-R BT.2100) are converted to light on a display: of HLG for a display of 1000 cd/m2, as BT.2100 has it.
Reference white, 203 cd/m2 (ITU-R BT.2408), becomes 1; what is brighter than three quarters of it is compressed
smoothly, by the brightest channel, so that hues remain. Every frame of a file is converted alike, so still things keep
their colours. Other video is taken as sRGB, as players show it; with the primaries of Display P3, as telephones write
them, its light is converted to sRGB's primaries, and what lies outside of these is clipped.
"""

import logging
import os
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from structgstream.cameras import CameraRig
from structgstream.data.images import OPAQUE, reduced_mask
from structgstream.data.timeline import Clock, measured_rate, paired, period_seconds
from structgstream.data.video_index import (
    BT2020,
    DISPLAY_P3,
    HIGH_RANGE,
    HLG,
    SRGB,
    STREAM_FORMATS,
    UNSPECIFIED,
    VideoTrack,
    load_av,
    open_video,
    primaries_of,
    transfer_of,
    video_stream,
)
from structgstream.errors import CalibrationError, CaptureError
from structgstream.frames import MultiViewFrame

if TYPE_CHECKING:
    from av.container import InputContainer
    from av.video.frame import VideoFrame
    from av.video.reformatter import VideoReformatter
    from av.video.stream import VideoStream


log = logging.getLogger(__name__)
Picture = NDArray[np.uint8]
Mask = NDArray[np.bool_]


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

        Where a video cannot be decoded its camera is absent, with one warning (Note [Damaged videos]).
        """
        with ExitStack() as stack:
            decoders = [stack.enter_context(closing(self._pictures(name, start))) for name in self.rig]
            # Entered last, so that no thread is inside a decoder when the decoders close.
            pool = stack.enter_context(ThreadPoolExecutor(min(len(self.rig), os.cpu_count() or 1), "videos"))
            for index in range(start, len(self)):
                pictures = zip(self.rig, pool.map(lambda decoder: next(decoder), decoders), strict=True)
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
        where: the capture, for messages and for its name.
        fps: frames a second of the instants; measured from the time stamps when None. Without clocks it is only
            compared with those, since instants at a rounded rate would miss frames.
        clocks: camera name to its clock; None if time stamps are of one clock, and no camera has two frames for one
            instant.

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
    # Of one frame per camera any rate is right.
    rate = fps if fps and clocks is not None else measured or fps or 30.0
    seconds = {name: times[name] for name in rig}
    frames, apart = paired(seconds, fps=rate, where=str(where), training=rig.training, one_each=clocks is None)
    stamps = {
        name: tuple(None if frame is None else tracks[name].stamps[frame] for frame in own)
        for name, own in frames.items()
    }
    return VideoSource(where.name, rig, rate, tracks, stamps, points, apart)


MIN_PERIOD = 5e-4
"""Seconds between two frames, below which time stamps are not of frames; containers round to milliseconds."""


def measured_fps(tracks: Mapping[str, VideoTrack], clocks: Mapping[str, Clock] | None = None) -> float | None:
    """Frames a second of the common timeline by time stamp (``timeline.measured_rate``); None for one frame. Raises
    CaptureError if most frames of a video have the time of the one before."""
    for track in tracks.values():
        if len(track.stamps) > 1 and period_seconds(track.seconds) < MIN_PERIOD:
            raise CaptureError(
                f"Most of the {len(track.stamps)} frames of the video {track.path} have the time stamp of the one "
                "before (files that were joined byte by byte have each twice), so they cannot be matched with other "
                "cameras; write it again with the time of each frame."
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
    shifted = STREAM_FORMATS if len({track.container for track in tracks.values()}) > 1 else ()
    return {
        name: track.seconds - track.tick_seconds * (track.start if track.container in shifted else 0)
        for name, track in tracks.items()
    }


Damage = Callable[[int, int | None, str], None]
"""Called with the time stamps, in ticks, of the first frame that is lost and of the next key frame, and the reason."""

# Values of libswscale and of ISO/IEC 23091-2 that the bindings name differently from version to version.
AREA, BICUBIC, FULL_CHROMA, ACCURATE_ROUNDING = 0x20, 0x4, 0x2000, 0x40000
BT709, BT601, FULL_RANGE, LIMITED_RANGE = 1, 5, 2, 1
VPX = {"vp8": "libvpx", "vp9": "libvpx-vp9"}
MATRICES = {1: BT709, 4: 4, 5: BT601, 6: BT601, 7: 7, 9: 9, 10: 9}


def pictures_at(
    track: VideoTrack, stamps: Sequence[int | None], *, size: tuple[int, int], on_damage: Damage
) -> Generator[tuple[Picture, Mask | None] | None]:
    """For each of ``stamps`` the picture ``[H, W, 3]`` sRGB and where it is opaque, ``[H, W]``, or None.

    The second is None where all is opaque.

    Args:
        stamps: time stamps of its frames, ascending, in ticks; None where no picture is wanted.
        size: width and height of the pictures.
        on_damage: called for frames that cannot be decoded, whose pictures are None.
    """
    reformatter = load_av().video.reformatter.VideoReformatter()
    with closing(_decoded(track, [stamp for stamp in stamps if stamp is not None], on_damage)) as decoded:
        ready = next(decoded, None)
        for stamp in stamps:
            if ready is None or ready.pts != stamp:
                yield None
                continue
            yield _shown(ready, reformatter, track, size), _opaque(ready, track, size)
            ready = next(decoded, None)


def _decoded(track: VideoTrack, wanted: Sequence[int], on_damage: Damage) -> Generator["VideoFrame"]:
    """The frames at the time stamps ``wanted``, without those that are lost (Note [Damaged videos])."""
    if not wanted:
        return
    at, begin, early, restarted = 0, _key_before(track, wanted[0]), False, False
    while at < len(wanted):
        run = _Run(track, begin, early)
        with closing(run.frames()) as frames:
            for frame in frames:
                if frame.pts == wanted[at]:
                    at += 1
                    yield frame
                    if at == len(wanted):
                        return
        if begin is not None and not run.met:
            if not early:  # Without an index the seek may land behind the key frame (MPEG).
                early = True
                continue
            if not restarted:  # It may not decode alone (intra refresh).
                begin, early, restarted = None, False, True
                continue
        early = False
        following = bisect_right(track.keyframes, run.lost if begin is None else max(run.lost, begin))
        begin = track.keyframes[following] if following < len(track.keyframes) else None
        on_damage(run.lost, begin, run.reason)
        if begin is None:
            return
        at = max(at, bisect_left(wanted, begin))
        if at < len(wanted) and not restarted:  # Else every key frame is tried in its order, wherever reading starts.
            begin = max(begin, _key_before(track, wanted[at]) or begin)


@dataclass
class _Run:
    """Decodes a file from a key frame on, or from its beginning, up to the first damage."""

    track: VideoTrack  # the video
    begin: int | None  # time stamp of a key frame; None for the beginning
    early: bool = False  # whether to seek the key frame before that
    expected: int = 0  # number of the next frame in the video's order
    met: bool = False  # whether the frame at ``begin`` came
    reason: str = "a frame is missing or broken"  # why it ended

    @property
    def lost(self) -> int:
        """Time stamp of the first frame that did not come."""
        if not self.met and self.begin is not None:
            return self.begin
        return self.track.stamps[min(self.expected, len(self.track.stamps) - 1)]

    def frames(self) -> Generator["VideoFrame"]:
        """The frames in the order in which they are shown, each with the time stamp of the index."""
        av, stamps, begin = load_av(), self.track.stamps, self.begin
        with open_video(self.track.path) as container:
            stream = video_stream(container)
            stream.codec_context.thread_count = 1  # the cameras are the parallelism
            # AVI states the order in which frames are decoded, and they come in that in which they are shown.
            reordered = container.format.name == "avi" and stream.codec_context.has_b_frames
            try:
                if begin is not None:
                    earlier = _key_before(self.track, begin - 1)
                    target = begin if not self.early else stamps[0] if earlier is None else earlier
                    container.seek(target, stream=stream, backward=True)
                for frame in _frames_from_key(container, stream, any_frame=not self.track.keyframes):
                    if frame.pts is None or frame.pts < (stamps[0] if begin is None else begin):
                        continue  # cut by the container's edit list, or before the key frame
                    if not self.met and begin is not None and frame.pts > begin:
                        return
                    if not self.met:
                        self.expected, self.met = 0 if begin is None else bisect_left(stamps, begin), True
                    if reordered and self.expected < len(stamps):
                        frame.pts = stamps[self.expected]
                    if self.expected == len(stamps) or frame.pts != stamps[self.expected] or frame.is_corrupt:
                        return
                    self.expected += 1
                    yield frame
            except av.error.FFmpegError as error:
                self.reason = str(error.strerror)


def _frames_from_key(container: "InputContainer", stream: "VideoStream", *, any_frame: bool) -> Generator["VideoFrame"]:
    """The frames from the first key frame on: some decoders end at packets before it.

    Those of VP8 and VP9 with alpha are decoded by libvpx, where it is built in, as others leave it out.
    """
    decoder, vpx = stream.codec_context, VPX.get(stream.codec_context.name)
    has_alpha = "1" in (value for key, value in stream.metadata.items() if key.lower() == "alpha_mode")
    if has_alpha and vpx in load_av().codecs_available:
        decoder = load_av().CodecContext.create(vpx, "r")
    for packet in container.demux(stream):
        any_frame = any_frame or packet.is_keyframe
        if any_frame:
            yield from decoder.decode(packet)


def _key_before(track: VideoTrack, stamp: int) -> int | None:
    """The last key frame up to ``stamp``; None for the beginning of the file."""
    found = bisect_right(track.keyframes, stamp)
    return track.keyframes[found - 1] if found > 1 else None


def _shown(frame: "VideoFrame", reformatter: "VideoReformatter", track: VideoTrack, size: tuple[int, int]) -> Picture:
    """The picture as it is shown, at ``size``."""
    turned = track.quarter_turns % 2
    width, height = (frame.height, frame.width) if turned else (frame.width, frame.height)
    if (width, height) != (track.width, track.height):
        seconds = ((frame.pts or 0) - track.origin) * track.tick_seconds
        raise CaptureError(
            f"The video {track.path} changes its size from {track.width}x{track.height} to {width}x{height} at "
            f"{seconds:.3f} s, and a camera has one; end the take before it (--frames), or film again."
        )
    if not track.quarter_turns:
        return srgb(frame, reformatter, width=size[0], height=size[1])
    width, height = size[::-1] if turned else size
    return np.ascontiguousarray(np.rot90(srgb(frame, reformatter, width=width, height=height), track.quarter_turns))


def _opaque(frame: "VideoFrame", track: VideoTrack, size: tuple[int, int]) -> Mask | None:
    """Where the picture is opaque, as it is shown, at ``size``; None where it is everywhere."""
    if not any(component.is_alpha for component in frame.format.components):
        return None
    opaque = frame.to_ndarray(format="rgba")[..., 3] >= OPAQUE * 255
    return None if opaque.all() else reduced_mask(np.rot90(opaque, track.quarter_turns), size)


def srgb(frame: "VideoFrame", reformatter: "VideoReformatter", *, width: int, height: int) -> NDArray[np.uint8]:
    """Colours by the frame's own matrix and range, stated because the defaults differ between tools.

    A file that states no matrix gets BT.709 from 720 lines on and BT.601 below, as broadcasting has it; one
    that states no range is taken as limited unless its pixel format states otherwise. HLG, PQ and the primaries of
    Display P3 are converted (Note [High dynamic range]).
    """
    matrix = MATRICES.get(int(frame.colorspace), BT709 if frame.height >= 720 else BT601)
    source_range = int(frame.color_range)
    if source_range not in (FULL_RANGE, LIMITED_RANGE):
        full = frame.format.name.startswith(("yuvj", "rgb", "bgr", "gbr"))
        source_range = FULL_RANGE if full else LIMITED_RANGE
    transfer, primaries = transfer_of(frame), primaries_of(frame)
    high = transfer in HIGH_RANGE
    converts = high or primaries == DISPLAY_P3
    shrinks = width < frame.width or height < frame.height
    converted = reformatter.reformat(
        frame,
        width=width,
        height=height,
        format="rgb48le" if converts else "rgb24",
        src_colorspace=matrix,
        dst_colorspace=matrix,
        src_color_range=source_range,
        dst_color_range=FULL_RANGE,
        interpolation=(AREA if shrinks else BICUBIC) | FULL_CHROMA | ACCURATE_ROUNDING,
        threads=1,
    )
    if not converts:
        return cast(NDArray[np.uint8], converted.to_ndarray())
    values = cast(NDArray[np.uint16], converted.to_ndarray())
    return high_range_to_srgb(values, transfer, primaries) if high else display_p3_to_srgb(values)


WHITE, PEAK, KNEE = 203.0, 1000.0, 0.75
"""Reference white and the display's peak, cd/m2; where compression begins, relative to reference white."""
BT2020_TO_709 = np.array(
    [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]], np.float32
)  # ITU-R BT.2087
DISPLAY_P3_TO_709 = np.array(
    [[1.2249, -0.2249, 0.0], [-0.0421, 1.0421, 0.0], [-0.0196, -0.0786, 1.0982]], np.float32
)  # From the chromaticities of SMPTE EG 432-1 and BT.709, both with D65.
LUMA_2020 = np.array([0.2627, 0.6780, 0.0593], np.float32)


def display_p3_to_srgb(picture: NDArray[np.uint16]) -> NDArray[np.uint8]:
    """sRGB of a picture ``[H, W, 3]`` in Display P3, full range. What lies outside of sRGB's primaries is clipped."""
    return _encoded(np.maximum(_decoding(SRGB)[picture] @ DISPLAY_P3_TO_709.T, 0))


def high_range_to_srgb(picture: NDArray[np.uint16], transfer: int, primaries: int) -> NDArray[np.uint8]:
    """sRGB of a picture ``[H, W, 3]`` of high dynamic range (:data:`HLG` or PQ), full range (Note [High dynamic
    range]). Primaries that are not stated are those of BT.2020."""
    light = _decoding(transfer)[picture]
    if transfer == HLG:  # Scene light to a display's, by luminance: the system gamma of 1.2.
        light *= np.maximum(light @ LUMA_2020, 1e-9)[..., None] ** np.float32(0.2) * np.float32(PEAK / WHITE)
    if primaries in (BT2020, UNSPECIFIED):
        light = light @ BT2020_TO_709.T
    elif primaries == DISPLAY_P3:
        light = light @ DISPLAY_P3_TO_709.T
    np.maximum(light, 0, out=light)
    brightest = np.maximum(light.max(axis=2, keepdims=True), 1e-9)
    shoulder = KNEE + (1 - KNEE) * -np.expm1((KNEE - brightest) / (1 - KNEE))
    light *= np.where(brightest > KNEE, shoulder / brightest, 1)
    return _encoded(light)


@cache
def _decoding(transfer: int) -> NDArray[np.float32]:
    """Light of each of 65536 values: of HLG the scene's, up to 1; of sRGB and PQ the display's, reference white 1."""
    signal = np.linspace(0, 1, 65536)
    if transfer == SRGB:
        light = np.where(signal <= 0.04045, signal / 12.92, ((signal + 0.055) / 1.055) ** 2.4)
    elif transfer == HLG:
        a, b, c = 0.17883277, 0.28466892, 0.55991073
        light = np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - c) / a) + b) / 12)
    else:
        m1, m2, c1, c2, c3 = 2610 / 16384, 2523 / 32, 3424 / 4096, 2413 / 128, 2392 / 128
        root = signal ** (1 / m2)
        light = (np.maximum(root - c1, 0) / (c2 - c3 * root)) ** (1 / m1) * 10000 / WHITE
    return light.astype(np.float32)


def _encoded(light: NDArray[np.float32]) -> NDArray[np.uint8]:
    return _encoding()[(np.minimum(light, 1) * 4095 + 0.5).astype(np.uint16)]


@cache
def _encoding() -> NDArray[np.uint8]:
    """sRGB of each of 4096 values of light."""
    light = np.linspace(0, 1, 4096)
    coded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return (coded * 255 + 0.5).astype(np.uint8)

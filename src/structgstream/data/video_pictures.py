# SPDX-License-Identifier: Apache-2.0
"""Decodes the pictures of a video at given time stamps.

Note [Damaged videos]
~~~~~~~~~~~~~~~~~~~~~
A frame counts as decodable if all frames from the key frame before it on are. So what is lost does not depend on where
reading starts, and a resumed stream sees what the first run saw. After damage, reading continues at the next key frame.
"""

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from structgstream.data.images import OPAQUE, reduced_mask
from structgstream.data.transfer import BT2020, HIGH_RANGE, high_range_to_srgb, transfer_of
from structgstream.data.video_index import VideoTrack, load_av, open_video, video_stream
from structgstream.errors import CaptureError

if TYPE_CHECKING:
    from av.container import InputContainer
    from av.video.frame import VideoFrame
    from av.video.reformatter import VideoReformatter
    from av.video.stream import VideoStream

Picture = NDArray[np.uint8]
Mask = NDArray[np.bool_]
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
        track: the video.
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
    at, begin, seeks = 0, _key_before(track, wanted[0]), True
    while at < len(wanted):
        run = _Run(track, begin)
        with closing(run.frames()) as frames:
            for frame in frames:
                if frame.pts == wanted[at]:
                    at += 1
                    yield frame
                    if at == len(wanted):
                        return
        if run.landed_late:  # Such a file is read from its beginning, and given up at its first damage.
            begin, seeks = None, False
            continue
        following = bisect_right(track.keyframes, run.lost if begin is None else max(run.lost, begin))
        begin = track.keyframes[following] if seeks and following < len(track.keyframes) else None
        on_damage(run.lost, begin, run.reason)
        if begin is None:
            return
        at = max(at, bisect_left(wanted, begin))
        if at < len(wanted):
            begin = max(begin, _key_before(track, wanted[at]) or begin)


@dataclass
class _Run:
    """Decodes a file from a key frame on, or from its beginning, up to the first damage."""

    track: VideoTrack  # the video
    begin: int | None  # time stamp of a key frame; None for the beginning
    expected: int = 0  # number of the next frame in the video's order
    met: bool = False  # whether the first frame came
    landed_late: bool = False  # whether the seek landed after the key frame, as it may without an index (MPEG-TS)
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
                    container.seek(begin, stream=stream, backward=True)
                for frame in _frames_from_key(container, stream, any_frame=not self.track.keyframes):
                    if frame.pts is None or frame.pts < (stamps[0] if begin is None else begin):
                        continue  # cut by the container's edit list, or before the key frame
                    if not self.met and begin is not None and frame.pts > begin:
                        self.landed_late = container.format.name == "mpegts"
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
    that states no range is taken as limited unless its pixel format states otherwise. HLG and PQ are converted
    (``transfer``).
    """
    matrix = MATRICES.get(int(frame.colorspace), BT709 if frame.height >= 720 else BT601)
    source_range = int(frame.color_range)
    if source_range not in (FULL_RANGE, LIMITED_RANGE):
        full = frame.format.name.startswith(("yuvj", "rgb", "bgr", "gbr"))
        source_range = FULL_RANGE if full else LIMITED_RANGE
    transfer = transfer_of(frame)
    high = transfer in HIGH_RANGE
    shrinks = width < frame.width or height < frame.height
    converted = reformatter.reformat(
        frame,
        width=width,
        height=height,
        format="rgb48le" if high else "rgb24",
        src_colorspace=matrix,
        dst_colorspace=matrix,
        src_color_range=source_range,
        dst_color_range=FULL_RANGE,
        interpolation=(AREA if shrinks else BICUBIC) | FULL_CHROMA | ACCURATE_ROUNDING,
        threads=1,
    )
    if high:
        wide = int(getattr(frame, "color_primaries", BT2020)) == BT2020
        return high_range_to_srgb(cast(NDArray[np.uint16], converted.to_ndarray()), transfer, wide=wide)
    return cast(NDArray[np.uint8], converted.to_ndarray())

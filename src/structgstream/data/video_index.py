# SPDX-License-Identifier: Apache-2.0
"""The index of a video file: when each frame is shown, and how the picture lies.

Videos are opened by :func:`open_video` alone.
"""

import os
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from structgstream.errors import CaptureError, MissingExtraError

if TYPE_CHECKING:
    from av.container import InputContainer
    from av.packet import Packet
    from av.video.frame import VideoFrame
    from av.video.stream import VideoStream

# Containers that store presentation times; AVI does not.
VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".mkv", ".webm", ".m4v", ".ts"})
PROGRESSIVE = 1  # the largest AVFieldOrder of pictures that are not fields; 0 is unknown
# The upper left of a display matrix (ISO/IEC 14496-12) and the quarter turns counterclockwise that it stands for.
TURNS = {(1, 0, 0, 1): 0, (0, -1, 1, 0): 1, (-1, 0, 0, -1): 2, (0, 1, -1, 0): 3}


@dataclass(frozen=True)
class VideoTrack:
    """The index of a video file.

    Args:
        path: the file.
        stamps: presentation time of every frame, ascending, in ticks.
        tick_seconds: length of a tick.
        width: width of the picture as it is shown, pixels.
        height: height of the picture as it is shown, pixels.
        quarter_turns: counterclockwise quarter turns of the stored picture to the shown one, 0 to 3.
        keyframes: presentation times, ascending, in ticks, of the frames that decode alone.
    """

    path: Path
    stamps: tuple[int, ...]
    tick_seconds: float
    width: int
    height: int
    quarter_turns: int = 0
    keyframes: tuple[int, ...] = ()

    @property
    def seconds(self) -> NDArray[np.float64]:
        """The time stamps in seconds."""
        return np.array(self.stamps, dtype=np.float64) * self.tick_seconds


def scan_videos(paths: Mapping[str, Path]) -> dict[str, VideoTrack]:
    """The index of every video; only the first frame of each is decoded.

    Raises:
        CaptureError: a file is missing, truncated, or not a video; its codec is unknown; it is interlaced, or turned by
            an angle that is not a quarter turn.
    """
    with ThreadPoolExecutor(min(len(paths), os.cpu_count() or 1) or 1) as pool:
        return dict(zip(paths, pool.map(_scan, paths.values()), strict=True))


def load_av() -> ModuleType:
    """The module ``av``, from the extra ``capture``."""
    try:
        import av
    except ImportError:
        raise MissingExtraError("av", "capture") from None
    return av


def open_video(path: Path) -> "InputContainer":
    """The opened file, which has a video stream.

    Raises:
        CaptureError: it is missing, not a video, or coded in an unknown way.
    """
    av = load_av()
    try:
        container = av.open(str(path))
    except FileNotFoundError:
        raise CaptureError(f"The video {path} is missing; restore the file.") from None
    except PermissionError:
        raise CaptureError(f"The video {path} cannot be opened (Permission denied); let yourself read it.") from None
    except (av.error.FFmpegError, OSError) as error:
        raise CaptureError(
            f"The video {path} cannot be opened ({error.strerror}): it is truncated, damaged or not a video; "
            "copy or record it again."
        ) from None
    reason = None
    if not container.streams.video:
        reason = f"The file {path} has no video stream; expected one video per camera."
    elif container.streams.video[0].codec_context is None:
        reason = (
            f"The video {path} is coded in a way that the installed PyAV cannot decode; convert it to H.264 or HEVC "
            "in mp4, keeping the time of each frame."
        )
    if reason is not None:
        container.close()
        raise CaptureError(reason)
    return container


def _scan(path: Path) -> VideoTrack:
    """Reads all packets of a file for their time stamps, and checks that none is missing."""
    av = load_av()
    with open_video(path) as container:
        stream = container.streams.video[0]
        first: VideoFrame | None = None
        packets: list[Packet] = []
        try:
            for packet in container.demux(stream):
                first = _first_frame(packet) if first is None else first
                if packet.size:
                    packets.append(packet)
        except av.error.FFmpegError as error:
            raise CaptureError(f"The video {path} is damaged ({error.strerror}); copy or record it again.") from None
        if not packets or any(packet.is_corrupt for packet in packets) or len(packets) < stream.frames:
            raise CaptureError(
                f"The video {path} is truncated: its index announces {stream.frames or 'some'} frames, "
                f"{sum(not packet.is_corrupt for packet in packets)} are there; copy or record it again."
            )
        shown = [packet for packet in packets if not packet.is_discard]
        stamps = [packet.pts for packet in shown if packet.pts is not None]
        if len(stamps) != len(shown) or stream.time_base is None:
            raise CaptureError(
                f"The video {path} has frames without time stamps, so it cannot be synchronised; "
                "remux it to a container that stores them (mp4, mkv)."
            )
        keys = [packet.pts for packet in packets if packet.is_keyframe and packet.pts is not None]
        turns = _quarter_turns(path, stream, first)
        size = (stream.height, stream.width) if turns % 2 else (stream.width, stream.height)
        seconds = float(stream.time_base)
        return VideoTrack(path, tuple(sorted(stamps)), seconds, *size, turns, tuple(sorted(keys)))


def _first_frame(packet: "Packet") -> "VideoFrame | None":
    """The first frame that the decoder gives out for a packet; None without one, or if it is damaged."""
    try:
        return next(iter(packet.decode()), None)  # pyright: ignore[reportReturnType]
    except load_av().error.FFmpegError:
        return None


def _quarter_turns(path: Path, stream: "VideoStream", frame: "VideoFrame | None") -> int:
    """How the stored picture must be turned to be shown.

    Raises:
        CaptureError: it is mirrored, turned by another angle, or two fields.
    """
    if stream.codec_context.field_order > PROGRESSIVE or (frame is not None and frame.interlaced_frame):
        raise CaptureError(
            f"The video {path} is interlaced: its lines are of two instants; set the camera to a progressive mode "
            "(25p, 30p, 50p, 60p), or deinterlace the video to frames first."
        )
    matrix = None if frame is None else frame.side_data.get("DISPLAYMATRIX")
    if matrix is None:
        return 0
    a, b, _, c, d, *_ = np.frombuffer(bytes(matrix), "<i4") / 65536
    turns = TURNS.get((a, b, c, d))
    if turns is None:
        what = "mirrored" if a * d - b * c < 0 else "turned by an angle that is not a quarter turn"
        raise CaptureError(
            f"The metadata of the video {path} say that it is {what}; convert it to one that is stored as it is shown."
        )
    return turns

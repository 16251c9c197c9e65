# SPDX-License-Identifier: Apache-2.0
"""The index of a video file: when each frame is shown, how the picture lies, and what is stated of its colours.

Videos are opened by :func:`open_video` alone. One that is missing, cut, no video, or of a kind that is not read is a
``CaptureError``.
"""

import logging
import os
from bisect import bisect_left
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from structgstream.errors import CaptureError, import_extra

if TYPE_CHECKING:
    from av.container import InputContainer
    from av.packet import Packet
    from av.video.frame import VideoFrame
    from av.video.stream import VideoStream

log = logging.getLogger(__name__)

VIDEO_SUFFIXES = frozenset({
    ".mp4", ".mov", ".m4v", ".3gp", ".360", ".mkv", ".webm", ".avi", ".ts", ".mts", ".m2ts", ".mpg", ".mpeg", ".mxf",
    ".nut", ".flv", ".asf", ".wmv", ".ogv", ".ogg", ".y4m", ".h264", ".264", ".h265", ".265", ".hevc",
})  # fmt: skip
STREAM_FORMATS = frozenset({"mpegts", "mpeg"})
"""FFmpeg's names of containers for transmission, whose time stamps begin anywhere; files of the others begin at 0."""
PROGRESSIVE = 1  # the largest AVFieldOrder of pictures that are not fields; 0 is unknown
# The upper left of a display matrix (ISO/IEC 14496-12) and the quarter turns counterclockwise that it stands for.
TURNS: Mapping[tuple[float, ...], int] = {
    (1, 0, 0, 1): 0,
    (0, -1, 1, 0): 1,
    (-1, 0, 0, -1): 2,
    (0, 1, -1, 0): 3,
}


# Numbers of ISO/IEC 23091-2.
UNSPECIFIED, SRGB, PQ, HLG = 2, 13, 16, 18
BT2020, DCI_P3, DISPLAY_P3 = 9, 11, 12
HIGH_RANGE = frozenset({PQ, HLG})
DISPLAY_REFERRED = frozenset({0, 1, UNSPECIFIED, 4, 5, 6, 7, 11, 12, 13, 14, 15})
TRANSFERS = {1: "BT.709", 4: "gamma 2.2", 5: "gamma 2.8", 6: "BT.601", 7: "SMPTE 240M", 8: "linear", 9: "logarithmic",
             10: "logarithmic", 11: "xvYCC", 12: "BT.1361", SRGB: "sRGB", 14: "BT.2020", 15: "BT.2020", PQ: "PQ",
             17: "SMPTE 428", HLG: "HLG"}  # fmt: skip
PRIMARIES = {1: "BT.709", 4: "BT.470M", 5: "BT.470BG", 6: "SMPTE 170M", 7: "SMPTE 240M", BT2020: "BT.2020",
             DCI_P3: "DCI-P3", DISPLAY_P3: "Display P3"}  # fmt: skip
MATRICES = {0: "RGB", 1: "BT.709", 4: "FCC", 5: "BT.601", 6: "BT.601", 7: "SMPTE 240M", 9: "BT.2020",
            10: "BT.2020 constant luminance"}  # fmt: skip
UNREAD_MATRICES = {8: "YCgCo", 11: "SMPTE 2085", 12: "chromaticity-derived", 13: "chromaticity-derived", 14: "ICtCp",
                   15: "IPT, as Dolby Vision's profile 5", 16: "YCgCo-R", 17: "YCgCo-R"}  # fmt: skip


@dataclass(frozen=True)
class VideoTrack:
    """The index of a video file."""

    path: Path  # the file
    stamps: tuple[int, ...]  # presentation time of every frame, ascending, in ticks
    tick_seconds: float  # length of a tick
    width: int  # width of the picture as it is shown, pixels
    height: int  # height of the picture as it is shown, pixels
    quarter_turns: int = 0  # counterclockwise quarter turns of the stored picture to the shown one, 0 to 3
    keyframes: tuple[int, ...] = ()  # presentation times, ascending, in ticks, of the frames that decode alone
    colors: str = ""  # what the file states of its colours, in words
    origin: int = 0  # ticks of time 0. AVI states no presentation times; its first frame is at 0
    container: str = ""  # FFmpeg's name of the container
    start: int = 0  # presentation time, in ticks, of the first picture, which may be one that does not decode
    pixel_aspect: float = 1.0  # how many times as wide as high a stored pixel is to be shown; anamorphic ones are not 1

    @property
    def seconds(self) -> NDArray[np.float64]:
        """The time stamps in seconds."""
        return (np.array(self.stamps, dtype=np.float64) - self.origin) * self.tick_seconds


def scan_videos(paths: Mapping[str, Path]) -> dict[str, VideoTrack]:
    """The index of every video; only the first frame of each is decoded."""
    with ThreadPoolExecutor(min(len(paths), os.cpu_count() or 1) or 1) as pool:
        return dict(zip(paths, pool.map(_scan, paths.values()), strict=True))


def load_av() -> ModuleType:
    """The module ``av``, from the extra ``capture``."""
    return import_extra("av", "capture")


def open_video(path: Path) -> "InputContainer":
    """The opened file, which has a video stream."""
    av = load_av()
    try:
        container = av.open(str(path), metadata_errors="replace")
    except FileNotFoundError:
        raise CaptureError(f"The video {path} is missing; restore the file.") from None
    except PermissionError:
        raise CaptureError(f"The video {path} cannot be opened (Permission denied); let yourself read it.") from None
    except (av.error.FFmpegError, OSError) as error:
        raise CaptureError(
            f"The video {path} cannot be opened ({error.strerror}): it is truncated, damaged or not a video; "
            "copy or record it again."
        ) from None
    found = _pictures_streams(container)
    if found and found[0].codec_context is not None:
        return container
    container.close()
    if not found:
        raise CaptureError(f"The file {path} has no video stream; expected one video per camera.")
    raise CaptureError(
        f"The video {path} is coded in a way that the installed PyAV cannot decode; convert it to H.264 or HEVC "
        "in mp4, keeping the time of each frame."
    )


def video_stream(container: "InputContainer") -> "VideoStream":
    """The stream that was filmed: no cover picture, no thumbnail, and of several the one with the most pixels."""
    return _pictures_streams(container)[0]


def _pictures_streams(container: "InputContainer") -> list["VideoStream"]:
    """The streams of pictures, the one that was filmed first."""
    av = load_av()

    def rank(stream: "VideoStream") -> tuple[bool, bool, bool, int]:
        attached = bool(stream.disposition & av.stream.Disposition.attached_pic)
        known = stream.codec_context is not None
        return attached, not known, stream.frames == 1, -(stream.width * stream.height if known else 0)

    return sorted(container.streams.video, key=rank)


def _scan(path: Path) -> VideoTrack:
    """Reads all packets of a file for their time stamps, and checks that none is missing."""
    av = load_av()
    with open_video(path) as container:
        stream = video_stream(container)
        _report_other_streams(path, container, stream)
        first: VideoFrame | None = None
        packets: list[Packet] = []
        started = False
        try:
            for packet in container.demux(stream):
                started = started or packet.is_keyframe
                first = _first(packet.decode) if first is None and started else first
                if packet.size:
                    packets.append(packet)
        except av.error.FFmpegError as error:
            raise CaptureError(f"The video {path} is damaged ({error.strerror}); copy or record it again.") from None
        whole = sum(not packet.is_corrupt for packet in packets)
        count = len(packets)
        if packets and container.format.name == "avi" and packets[-1].dts is not None:
            # An empty packet stands for a frame that the recorder dropped, also after the last one.
            count = packets[-1].dts + max(packets[-1].duration or 1, 1)
        if not whole or count < stream.frames or (packets[-1].is_corrupt and not packets[-1].is_keyframe):
            raise CaptureError(
                f"The video {path} is truncated: its index announces {stream.frames or 'some'} frames, "
                f"{whole} are there; copy or record it again."
            )
        shown = [packet for packet in packets if not packet.is_discard]
        stamps = sorted(packet.pts for packet in shown if packet.pts is not None)
        if len(stamps) != len(shown) or stream.time_base is None:
            raise CaptureError(
                f"The video {path} has frames without time stamps (the first of them is number "
                f"{next((n for n, packet in enumerate(shown) if packet.pts is None), 0)} in the file), so it cannot be "
                "synchronised; write it again with times from 0 on, as mp4 or mkv."
            )
        keys = [packet.pts for packet in packets if packet.is_keyframe and packet.pts is not None]
        seconds = float(stream.time_base)
        if not started:  # Some recorders mark no key frame, or write none.
            with open_video(path) as again:
                first = _first(lambda: again.decode(video_stream(again)))
        start = stamps[0] if stamps else 0
        origin = start - (packets[0].dts or 0) if container.format.name == "avi" else 0
        stamps = _decodable(path, stamps, first, seconds)
        turns = _quarter_turns(path, stream, first)
        size = (stream.height, stream.width) if turns % 2 else (stream.width, stream.height)
        colors = stated_colors(path, first)
        return VideoTrack(
            path, tuple(stamps), seconds, *size, turns, tuple(sorted(keys)), colors, origin, container.format.name,
            start, float(stream.sample_aspect_ratio or 1),
        )  # fmt: skip


def _decodable(path: Path, stamps: list[int], first: "VideoFrame | None", seconds: float) -> list[int]:
    """The time stamps from the first frame that decodes on: what is before the first key frame lacks its beginning.

    So which frames a video has does not depend on where reading starts.
    """
    if first is None or first.pts is None:
        return stamps
    begin = bisect_left(stamps, first.pts)
    if 0 < begin < len(stamps):
        log.warning(
            "The video %s begins within a group of pictures: %d frames before its first one that decodes, at %.3f s, "
            "are left out",
            path, begin, first.pts * seconds,
        )  # fmt: skip
        return stamps[begin:]
    return stamps


def _report_other_streams(path: Path, container: "InputContainer", taken: "VideoStream") -> None:
    """A warning where several streams may have been meant."""
    size = (taken.width, taken.height)
    alike = [
        stream.index
        for stream in _pictures_streams(container)
        if stream.codec_context is not None and stream.frames != 1 and (stream.width, stream.height) == size
    ]
    if len(alike) > 1:
        log.warning(
            "The video %s has %d streams of %dx%d pixels, numbers %s; number %d is read. If another is meant, write it "
            "to a file of its own",
            path, len(alike), *size, ", ".join(map(str, alike)), taken.index,
        )  # fmt: skip


def _first(decode: Callable[[], Iterable[Any]]) -> Any:
    """The first frame that a decoder gives out; None without one, or if it is damaged."""
    try:
        return next(iter(decode()), None)
    except load_av().error.FFmpegError:
        return None


def _quarter_turns(path: Path, stream: "VideoStream", frame: "VideoFrame | None") -> int:
    """How the stored picture must be turned to be shown."""
    if stream.codec_context.field_order > PROGRESSIVE or (frame is not None and frame.interlaced_frame):
        raise CaptureError(
            f"The video {path} is interlaced: its lines are of two instants; set the camera to a progressive mode "
            "(25p, 30p, 50p, 60p), or deinterlace the video to frames first."
        )
    a, b, c, d = (1, 0, 0, 1) if frame is None else display_matrix(frame)
    turns = TURNS.get((a, b, c, d))
    if turns is None:
        what = "mirrored" if a * d - b * c < 0 else "turned by an angle that is not a quarter turn"
        raise CaptureError(
            f"The metadata of the video {path} say that it is {what}; convert it to one that is stored as it is shown."
        )
    return turns


def display_matrix(frame: "VideoFrame") -> tuple[float, float, float, float]:
    """The upper left of the matrix that turns the stored picture to the shown one, by rows; else the identity."""
    matrix = frame.side_data.get("DISPLAYMATRIX")
    if matrix is None:
        return 1.0, 0.0, 0.0, 1.0
    a, b, _, c, d, *_ = np.frombuffer(bytes(matrix), "<i4") / 65536
    return float(a), float(b), float(c), float(d)


def transfer_of(frame: "VideoFrame") -> int:
    """The transfer function that a frame states, as the number of ISO/IEC 23091-2."""
    return int(getattr(frame, "color_trc", UNSPECIFIED))


def primaries_of(frame: "VideoFrame") -> int:
    """The primaries that a frame states, as the number of ISO/IEC 23091-2."""
    return int(getattr(frame, "color_primaries", UNSPECIFIED))


def stated_colors(path: Path, frame: "VideoFrame | None") -> str:
    """What a video states of its colours, in words; ``frame`` is one of its frames, None if none decodes.

    Raises:
        CaptureError: a transfer function or a matrix that is not converted, the primaries of BT.2020 without HLG or PQ,
            or those of DCI-P3.
    """
    if frame is None:
        return "no frame decodes"
    transfer, primaries = transfer_of(frame), primaries_of(frame)
    if transfer not in HIGH_RANGE and primaries == BT2020:
        raise CaptureError(
            f"The video {path} has the primaries of BT.2020 and does not state HLG or PQ, as log videos have it, so "
            "its colours are not those of sRGB; convert it to BT.709 with the camera maker's conversion, keeping the "
            "time of each frame, or film in BT.709."
        )
    if primaries == DCI_P3:
        raise CaptureError(
            f"The video {path} has the primaries of DCI-P3, whose white is a cinema projector's; expected BT.709, "
            "Display P3 or BT.2020: convert it to BT.709, keeping the time of each frame."
        )
    if transfer not in DISPLAY_REFERRED | HIGH_RANGE:
        what = TRANSFERS.get(transfer, f"number {transfer}")
        raise CaptureError(
            f"The video {path} states a transfer function ({what}) that is not read; expected BT.709, sRGB, BT.2020, "
            "HLG or PQ: convert it to BT.709, keeping the time of each frame."
        )
    if (unread := UNREAD_MATRICES.get(int(frame.colorspace))) is not None:
        raise CaptureError(
            f"The video {path} states a colour matrix ({unread}) that is not read; expected RGB, BT.601, BT.709 or "
            "BT.2020: convert it to BT.709, keeping the time of each frame."
        )
    matrix = MATRICES.get(int(frame.colorspace), "no matrix stated")
    bounds = {1: "limited range", 2: "full range"}.get(int(frame.color_range), "no range stated")
    words = [frame.format.name, matrix, bounds]
    words += [f"primaries {PRIMARIES[primaries]}"] if primaries in PRIMARIES else []
    words += [TRANSFERS[transfer]] if transfer in TRANSFERS else []
    words += ["converted to sRGB"] if transfer in HIGH_RANGE or primaries == DISPLAY_P3 else []
    return ", ".join(words)

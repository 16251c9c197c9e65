# SPDX-License-Identifier: Apache-2.0
"""Short videos, coded once, as MPEG-TS whose stamps may be any."""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

from camera_lines import Line

TICKS = 90_000
WRAP = 2**33


@dataclass(frozen=True)
class Loop:
    """A short video whose first frame is a key frame, coded once.

    Args:
        template: stream of the coded video.
        packets: of one round, in the order of showing, which is that of coding.
    """

    template: Any
    packets: Sequence[bytes]

    @classmethod
    def of(cls, pictures: Sequence[NDArray[np.uint8]]) -> "Loop":
        """Pictures ``[H, W, 3]`` of even sizes, without frames that refer to later ones."""
        height, width = pictures[0].shape[:2]
        container = av.open(io.BytesIO(), "w", format="mpegts")
        options = {"preset": "veryfast", "tune": "zerolatency", "crf": "18"}
        stream: Any = container.add_stream("libx264", rate=30, options=options)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.codec_context.gop_size = len(pictures)
        packets = []
        for number, picture in enumerate([*pictures, None]):
            frame = None if picture is None else av.VideoFrame.from_ndarray(picture, format="rgb24")
            if frame is not None:
                frame.pts, frame.time_base = number, Fraction(1, 30)
            packets += [bytes(packet) for packet in stream.encode(frame) if packet.size]
        return cls(stream, packets)


class _Written(io.RawIOBase):
    """A file that a muxer writes: it hands the bytes on, with the presentation time that is wanted.

    A muxer refuses stamps that repeat or go back, so it gets rising ones, and the five bytes that state the time in the
    header of a picture (ISO/IEC 13818-1, 2.4.3.6) are written again here.
    """

    def __init__(self, line: Line) -> None:
        super().__init__()
        self._line = line
        self.ticks: int | None = None

    def writable(self) -> bool:
        return True

    def write(self, data: Any) -> int:
        packets = bytearray(data)
        for start in range(0, len(packets) - 187, 188):
            header = start + 4 + (packets[start + 4] + 1 if packets[start + 3] & 0x20 else 0)
            begins = packets[start + 1] & 0x40 and packets[header : header + 3] == b"\0\0\1"
            if begins and packets[header + 3] == 0xE0 and self.ticks is not None:
                packets[header + 9 : header + 14] = presentation_time(self.ticks, mark=packets[header + 9] >> 4)
        return self._line.write(bytes(packets))


def presentation_time(ticks: int, *, mark: int = 2) -> bytes:
    """The five bytes of a time in the header of a picture."""
    ticks %= WRAP
    return bytes(
        [
            mark << 4 | (ticks >> 30) << 1 | 1,
            ticks >> 22 & 0xFF,
            (ticks >> 15 & 0x7F) << 1 | 1,
            ticks >> 7 & 0xFF,
            (ticks & 0x7F) << 1 | 1,
        ]
    )


class Muxer:
    """MPEG-TS of one loop to a line."""

    def __init__(self, loop: Loop, line: Line) -> None:
        options = {"mpegts_copyts": "1", "flush_packets": "1"}
        self._file = _Written(line)
        self._container: Any = av.open(self._file, "w", format="mpegts", options=options)
        self._stream = self._container.add_stream_from_template(loop.template)
        self._count = 0
        self.loop = loop

    def send(self, data: bytes, stamp: float, *, key: bool) -> None:
        packet = av.Packet(data)
        packet.stream, packet.time_base = self._stream, Fraction(1, TICKS)
        packet.pts = packet.dts = self._count = self._count + TICKS // 100
        packet.is_keyframe = key
        self._file.ticks = round(stamp * TICKS)
        self._container.mux_one(packet)

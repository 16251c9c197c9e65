# SPDX-License-Identifier: Apache-2.0
"""``tests/support/senders/send.py`` for tests: what cameras send, in memory or on the loopback."""

import importlib
import io
import sys
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

FOLDER = Path(__file__).parent / "senders"


def sender() -> ModuleType:
    """The module, which lies outside of any package."""
    if str(FOLDER) not in sys.path:
        sys.path.append(str(FOLDER))
    return importlib.import_module("send")


class Collected:
    """A line that keeps what is written."""

    def __init__(self) -> None:
        self.data = bytearray()

    def write(self, data: bytes) -> int:
        self.data += data
        return len(data)

    def close(self) -> None:
        return None


def moving_pictures(count: int = 12, *, width: int = 128, height: int = 96) -> list[NDArray[np.uint8]]:
    """A bright block that moves over a smooth ground, so that no two pictures are alike."""
    down, across = np.mgrid[:height, :width]
    ground = (40 + 60 * np.sin(across / 20) + 40 * np.cos(down / 15)).clip(0, 255)
    pictures = []
    for number in range(count):
        picture = np.repeat(ground[..., None], 3, 2).astype(np.uint8)
        left = 4 + number * (width - 28) // count
        picture[20:44, left : left + 20] = (230, 40 + 10 * number, 30)
        pictures.append(picture)
    return pictures


def coded_film(codec: str, numbers: Iterable[int], **options: str) -> bytes:
    """Pictures of the film of :func:`moving_pictures`, over and over, at the times of their numbers, as MPEG-TS."""
    written = io.BytesIO()
    with av.open(written, "w", format="mpegts") as output:
        stream = output.add_stream(codec, rate=30, options=options)
        assert isinstance(stream, av.VideoStream)
        stream.width, stream.height, stream.pix_fmt, stream.bit_rate = 128, 96, "yuv420p", 2_000_000
        for number in numbers:
            frame = av.VideoFrame.from_ndarray(moving_pictures()[number % 12], format="rgb24")
            frame.pts = number
            output.mux(stream.encode(frame))
        output.mux(stream.encode(None))
    return written.getvalue()


@cache
def sent_loops() -> dict[str, Any]:
    """The loops of a camera that films :func:`moving_pictures`."""
    return sender().loops_of(moving_pictures())


def sent_stream(*troubles: str, frames: int = 60, fps: float = 30.0, begun: float = 1000.0) -> bytes:
    """What a camera sends in ``frames`` pictures with the troubles ``FAULT:START:LENGTH``, as MPEG-TS."""
    module, line = sender(), Collected()
    parsed = [module.Trouble.parsed(f"a:{trouble}") for trouble in troubles]
    camera = module.SentCamera("a", sent_loops(), line, fps, parsed)
    for number in range(frames):
        camera.send(number, begun=begun)
    return bytes(line.data)

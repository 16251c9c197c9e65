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


def moving_pictures() -> list[NDArray[np.uint8]]:
    """Twelve of 128x96 pixels: a bright block that moves over a smooth ground, so that no two pictures are alike."""
    down, across = np.mgrid[:96, :128]
    ground = (40 + 60 * np.sin(across / 20) + 40 * np.cos(down / 15)).clip(0, 255)
    pictures = []
    for number in range(12):
        picture = np.repeat(ground[..., None], 3, 2).astype(np.uint8)
        left = 4 + number * 100 // 12
        picture[20:44, left : left + 20] = (230, 40 + 10 * number, 30)
        pictures.append(picture)
    return pictures


def number_shown(image: NDArray[np.uint8]) -> int:
    """Which of :func:`moving_pictures` it is, decoded; anything else fails."""
    errors = ((np.stack(moving_pictures()).astype(np.float64) - image) ** 2).mean((1, 2, 3))
    assert errors.min() < 60, "a picture that was never filmed"
    return int(errors.argmin())


def coded_film(codec: str, numbers: Iterable[int], *, form: str = "mpegts", **options: str) -> bytes:
    """Pictures of the film of :func:`moving_pictures`, over and over, at the times of their numbers."""
    written = io.BytesIO()
    with av.open(written, "w", format=form) as output:
        stream = output.add_stream(codec, rate=30, options=options)
        assert isinstance(stream, av.VideoStream)
        stream.width, stream.height, stream.bit_rate = 128, 96, 2_000_000
        stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
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


def sent_stream(*troubles: str, frames: int = 60, begun: float = 1000.0) -> bytes:
    """What a camera sends in ``frames`` pictures with the troubles ``FAULT:START:LENGTH``, as MPEG-TS."""
    module, line = sender(), Collected()
    parsed = [module.Trouble.parsed(f"a:{trouble}") for trouble in troubles]
    camera = module.SentCamera("a", sent_loops(), line, 30.0, parsed)
    for number in range(frames):
        camera.send(number, begun=begun)
    return bytes(line.data)

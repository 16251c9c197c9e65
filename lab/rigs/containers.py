# SPDX-License-Identifier: Apache-2.0
"""Writes what a camera leaves behind: H.264 with the stamps of its own clock, and its sound."""

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

from lab.rigs.sound import SAMPLE_RATE
from structgstream.data.video_writer import bt709_frame, state_bt709

TIME_BASE = Fraction(1, 90_000)
CRF = 14  # constant rate factor of x264


def write_video(
    path: Path,
    pictures: Iterable[NDArray[np.uint8]],
    stamps: Iterable[float],
    *,
    fps: float,
    sound: NDArray[np.float64] | None = None,
) -> None:
    """An mp4 of high quality.

    Args:
        path: to write.
        pictures: ``[H, W, 3]`` sRGB, of one even size.
        stamps: seconds, ascending, of each picture; rounded to 1/90000 s.
        fps: what the container states as its rate.
        sound: mono samples at :data:`SAMPLE_RATE` from second zero on, full scale 1.
    """
    with av.open(str(path), "w", options={"movflags": "+faststart"}) as container:
        video = container.add_stream(
            "libx264",
            rate=Fraction(fps).limit_denominator(1001),
            options={"crf": str(CRF), "preset": "veryfast", "threads": "1", "flags": "+bitexact", "g": "30"},
        )
        context = video.codec_context
        context.bit_rate = 0  # a rate left at its default would win over the constant quality
        context.time_base = TIME_BASE
        state_bt709(context)
        video.pix_fmt = "yuv420p"
        audio = None
        if sound is not None:
            audio = container.add_stream("aac", rate=SAMPLE_RATE, layout="mono")
            audio.codec_context.bit_rate = 128_000
        for number, (picture, stamp) in enumerate(zip(pictures, stamps, strict=True)):
            if number == 0:
                video.height, video.width = picture.shape[:2]
            frame = bt709_frame(picture)
            frame.pts, frame.time_base = round(stamp / TIME_BASE), TIME_BASE
            container.mux(video.encode(frame))
        container.mux(video.encode())
        if audio is not None and sound is not None:
            for start in range(0, len(sound), 1024):
                block = av.AudioFrame.from_ndarray(
                    sound[None, start : start + 1024].astype(np.float32), format="fltp", layout="mono"
                )
                block.sample_rate, block.pts, block.time_base = SAMPLE_RATE, start, Fraction(1, SAMPLE_RATE)
                container.mux(audio.encode(block))
            container.mux(audio.encode())

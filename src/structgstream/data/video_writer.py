# SPDX-License-Identifier: Apache-2.0
"""Writes pictures as a widely playable video: H.264 in mp4, 4:2:0, BT.709, constant quality; sound as AAC."""

from contextlib import AbstractContextManager, suppress
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from structgstream.atomic_files import ADVICE, give_name, partial_path
from structgstream.data.video import ACCURATE_ROUNDING, BICUBIC, BT709, FULL_RANGE, LIMITED_RANGE
from structgstream.data.video_index import load_av
from structgstream.errors import StorageError
from structgstream.opus import SAMPLE_RATE

SOUND_BITS_PER_SECOND = 128_000
TICKS = 90_000  # a second


class VideoWriter(AbstractContextManager["VideoWriter"]):
    """Writes an mp4, picture by picture, all of one size, at ``fps`` frames a second; a missing folder is made.

    The file gets its name when the ``with`` block ends without an error, so it is never incomplete. Odd sizes are
    padded by one pixel, because 4:2:0 needs even ones. Sound has 1 or 2 ``channels``, None for none. Raises
    StorageError if the file cannot be written, also later, or this PyAV has no H.264 encoder.
    """

    def __init__(self, path: Path, *, fps: float, channels: int | None = None) -> None:
        self._av = av = load_av()
        self.path, self._part = path, partial_path(path)
        self._fps = Fraction(fps).limit_denominator(1001)
        self._count = 0
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._container = av.open(str(self._part), "w", format="mp4", options={"movflags": "+faststart"})
            # Visually lossless; half the time of medium at the same size, 0.3 dB less.
            options = {"crf": "18", "preset": "veryfast"}
            self._stream = self._container.add_stream("libx264", rate=self._fps, options=options)
        except (OSError, ValueError, av.error.FFmpegError) as error:
            raise self._failed(error) from None
        self._stream.pix_fmt = "yuv420p"
        context = self._stream.codec_context
        context.bit_rate = 0  # a rate left at its default would win over the constant quality
        state_bt709(context)
        self._sound, self._heard = None, 0
        context.time_base = Fraction(1, TICKS)
        if channels is not None:
            self._sound = self._container.add_stream("aac", rate=SAMPLE_RATE)
            self._sound.layout = "mono" if channels == 1 else "stereo"
            self._sound.codec_context.bit_rate = SOUND_BITS_PER_SECOND

    def write(self, picture: NDArray[np.uint8], *, seconds: float | None = None) -> None:
        """Adds a picture ``[H, W, 3]`` sRGB, shown at ``seconds``; None: at the next multiple of the frames'
        distance."""
        height, width = picture.shape[:2]
        even = np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
        if self._count == 0:
            self._stream.height, self._stream.width = even.shape[:2]
        frame = bt709_frame(even)
        at = self._count / self._fps if seconds is None else seconds
        frame.pts, frame.time_base = round(at * TICKS), Fraction(1, TICKS)
        self._count += 1
        self._mux(frame)

    def write_sound(self, samples: NDArray[np.float32], *, seconds: float) -> None:
        """Adds sound ``[N, channels]`` in [-1, 1] at 48 kHz, later than all before, whose first sample sounds at
        ``seconds``; what lies before 0 is left out."""
        assert self._sound is not None, "made with channels"
        missing = round(seconds * SAMPLE_RATE) - self._heard
        silence = np.zeros((max(missing, 0), samples.shape[1]), np.float32)
        samples = np.concatenate([silence, samples[max(-missing, 0) :]])
        if not len(samples):
            return
        layout = self._sound.layout.name
        frame = self._av.AudioFrame.from_ndarray(np.ascontiguousarray(samples.T), format="fltp", layout=layout)
        frame.sample_rate, frame.pts, frame.time_base = SAMPLE_RATE, self._heard, Fraction(1, SAMPLE_RATE)
        self._heard += len(samples)
        self._mux(frame, self._sound)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None and self._count:
                self._mux(None)
                if self._heard:
                    self._mux(None, self._sound)
            self._container.close()
            if kind is None and self._count:
                give_name(self._part, self.path)
        except (OSError, self._av.error.FFmpegError) as problem:
            raise self._failed(problem) from None
        finally:
            with suppress(OSError):  # A read-only disk refuses to remove even what is not there.
                self._part.unlink(missing_ok=True)

    def _mux(self, frame: object, stream: Any = None) -> None:
        try:
            self._container.mux((stream or self._stream).encode(frame))  # pyright: ignore[reportArgumentType]
        except (OSError, self._av.error.FFmpegError) as error:
            raise self._failed(error) from None

    def _failed(self, error: Exception) -> StorageError:
        reason, number = getattr(error, "strerror", None) or error, getattr(error, "errno", None)
        return StorageError(f"The video {self.path} cannot be written ({reason}){ADVICE.get(number or 0, '')}.")


def state_bt709(codec_context: Any) -> None:
    """Writes into a stream of PyAV that its frames are those of :func:`bt709_frame`."""
    codec_context.color_range, codec_context.colorspace = LIMITED_RANGE, BT709
    codec_context.color_primaries, codec_context.color_trc = BT709, BT709


def bt709_frame(picture: NDArray[np.uint8], *, pixels: str = "yuv420p") -> Any:
    """A picture ``[H, W, 3]`` sRGB as a frame of PyAV, without a time stamp: BT.709, limited range, of FFmpeg's format
    ``pixels``."""
    frame = load_av().VideoFrame.from_ndarray(picture, format="rgb24")
    frame = frame.reformat(
        format=pixels,
        src_colorspace=BT709,
        dst_colorspace=BT709,
        src_color_range=FULL_RANGE,
        dst_color_range=LIMITED_RANGE,
        interpolation=BICUBIC | ACCURATE_ROUNDING,
    )
    frame.color_range, frame.colorspace = LIMITED_RANGE, BT709
    return frame

# SPDX-License-Identifier: Apache-2.0
"""The sound of a video, on the clock of its pictures."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from structgstream.data.video_index import load_av, open_video
from structgstream.errors import CaptureError

LONGEST_SECONDS = 7200.0


def read_audio(path: Path, *, rate: int = 48_000) -> NDArray[np.float32] | None:
    """Mono samples ``[N]`` in [-1, 1]; sample ``k`` sounds at ``k / rate`` seconds of the video's time stamps.

    Where the sound starts later than time 0, silence precedes it. None when the file has no sound.

    Raises:
        CaptureError: the file cannot be read, or is longer than two hours.
    """
    av = load_av()
    with open_video(path) as container:
        if not container.streams.audio:
            return None
        stream = container.streams.audio[0]
        resampler = av.AudioResampler(format="flt", layout="mono", rate=rate)
        parts: list[NDArray[np.float32]] = []
        start_seconds: float | None = None
        try:
            for frame in container.decode(stream):
                if start_seconds is None:
                    start_seconds = 0.0 if frame.time is None else float(frame.time)
                parts += [resampled.to_ndarray()[0] for resampled in resampler.resample(frame)]
            parts += [resampled.to_ndarray()[0] for resampled in resampler.resample(None)]
        except av.error.FFmpegError as error:
            raise CaptureError(
                f"The sound of {path} cannot be decoded ({error.strerror}); copy the file again, or synchronise by "
                "another method."
            ) from None
    if not parts or start_seconds is None:
        return None
    samples = np.concatenate(parts).astype(np.float32)
    first = round(start_seconds * rate)
    if len(samples) + first > LONGEST_SECONDS * rate:
        raise CaptureError(f"{path} is longer than two hours; cut it to the take.")
    return np.concatenate([np.zeros(first, np.float32), samples]) if first > 0 else samples[-first:]

# SPDX-License-Identifier: Apache-2.0
"""Claps, in files and in videos, and where they are in what was stored."""

from collections.abc import Iterable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

from structgstream.codec.reader import StreamReader
from structgstream.data.sound import SoundDecoder
from structgstream.opus import SAMPLE_RATE, OpusPacket

LOUD = 0.2
APART_SECONDS = 0.2  # of two claps at least


def claps(seconds: float, *at: float, rate: int = SAMPLE_RATE, channels: int = 1) -> NDArray[np.float32]:
    """Sound ``[channels, N]`` that is silent but for a burst of noise at these seconds."""
    samples = np.zeros((channels, round(seconds * rate)), np.float32)
    burst = np.random.default_rng(0).uniform(-0.9, 0.9, round(0.01 * rate))
    burst *= np.exp(-np.arange(len(burst)) / (0.003 * rate))
    for one in at:
        first = round(one * rate)
        end = min(first + len(burst), samples.shape[1])
        samples[:, first:end] = burst[: end - first]
    return samples


def layout_of(channels: int) -> str:
    """FFmpeg's name of a layout."""
    return {1: "mono", 2: "stereo", 6: "5.1"}[channels]


def write_sound(path: Path, samples: NDArray[np.float32], *, rate: int = SAMPLE_RATE) -> Path:
    """A file of sound alone."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("pcm_f32le" if path.suffix == ".wav" else "flac", rate=rate)
        stream.layout = layout_of(len(samples))
        _encode(container, stream, samples, rate)
    return path


def add_sound(
    video: Path,
    output: Path,
    samples: NDArray[np.float32],
    *,
    rate: int = SAMPLE_RATE,
    start: float = 0.0,
    codec: str = "aac",
) -> Path:
    """The same video with sound that begins at ``start`` seconds."""
    with av.open(str(video)) as given, av.open(str(output), "w") as container:
        pictures = container.add_stream_from_template(given.streams.video[0])
        stream: Any = container.add_stream(codec, rate=rate)
        stream.layout = layout_of(len(samples))
        for packet in given.demux(given.streams.video[0]):
            if packet.size:
                packet.stream = pictures
                container.mux(packet)
        _encode(container, stream, samples, rate, start=start)
    return output


def _encode(container, stream, samples: NDArray[np.float32], rate: int, *, start: float = 0.0) -> None:
    for part in np.array_split(samples, max(samples.shape[1] // rate, 1), axis=1):
        frame = av.AudioFrame.from_ndarray(np.ascontiguousarray(part), format="fltp", layout=layout_of(len(part)))
        frame.sample_rate, frame.time_base = rate, Fraction(1, rate)
        frame.pts = round(start * rate)
        start += part.shape[1] / rate
        container.mux(stream.encode(frame))
    container.mux(stream.encode(None))


def heard_at(parts: Iterable[tuple[float, Sequence[bytes]]], *, channels: int = 1) -> list[float]:
    """Presentation times of claps in packets of Opus, each with the time of the first."""
    decoder, found = SoundDecoder(channels), list[float]()
    for seconds, packets in parts:
        samples = decoder.decode(packets, seconds)
        for place in np.flatnonzero(np.abs(samples).max(axis=1, initial=0.0) > LOUD):
            at = seconds + place / SAMPLE_RATE
            if not found or at - found[-1] > APART_SECONDS:
                found.append(at)
    return found


def packets_heard(packets: Sequence[OpusPacket], *, channels: int = 1) -> list[float]:
    """Presentation times of claps in packets that follow each other."""
    return heard_at([(packets[0].seconds, [packet.data for packet in packets])], channels=channels)


def stream_heard(reader: StreamReader) -> list[float]:
    """Presentation times of claps in a stream."""
    assert reader.header.sound is not None
    sounds = [reader.sound(index) for index in range(len(reader))]
    parts = [(sound.seconds, sound.packets) for sound in sounds if sound is not None]
    return heard_at(parts, channels=reader.header.sound.channels)

# SPDX-License-Identifier: Apache-2.0
"""Films a capture again as phones would: ``python lab/phones/film.py CAPTURE build/phones``.

Each video is HEVC with 10 bits, stored as the sensor lies and turned by its metadata, begins at an instant of its own
with a clock of its own, has a variable frame rate (time stamps jitter, frames are dropped) and a microphone that hears
one clap, late by its distance. ``truth.json`` says what was done. Sizes must be even, and at least 64.
"""

import argparse
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

from structgstream.data.open import open_capture
from structgstream.data.source import FrameSource, SourceWrapper
from structgstream.data.video_writer import bt709_frame, state_bt709
from structgstream.frames import MultiViewFrame

Picture = NDArray[np.uint8]
TIME_BASE = Fraction(1, 90_000)
SAMPLE_RATE, BLOCK = 48_000, 1024
SPEED_OF_SOUND = 343.0
MAX_OFFSET_FRAMES = 6
MIN_SIDE = 64  # a block of x265, which corrupts its memory below that
JITTER_SECONDS, DROPPED = 0.0015, 0.04
CLAP_SECONDS, ROOM_NOISE = 0.02, 0.003


@dataclass(frozen=True)
class Phone:
    """What one phone did.

    Args:
        offset_seconds: time of the capture at the phone's zero.
        quarter_turns: counterclockwise, from the stored picture to the shown one.
        frames: of the capture, which it has.
        stamps: of these, seconds of its own clock.
        clap_seconds: when it hears the clap, by its own clock.
    """

    offset_seconds: float
    quarter_turns: int
    frames: tuple[int, ...]
    stamps: tuple[float, ...]
    clap_seconds: float


def planned(
    source: FrameSource, *, clap: float, place: Sequence[float], metres: float, seed: int, turns: Sequence[int]
) -> dict[str, Phone]:
    """What each camera of a capture does as a phone.

    Args:
        source: the capture.
        clap: when hands meet, seconds of the capture.
        place: where they do, in units of the capture.
        metres: in a unit of the capture.
        seed: of offsets, jitter and dropped frames.
        turns: quarter turns that phones take in turn.
    """
    g = np.random.default_rng(seed)
    found: dict[str, Phone] = {}
    for number, name in enumerate(source.rig):
        first = int(g.integers(0, min(MAX_OFFSET_FRAMES, len(source) // 3) + 1))
        zero = (first - g.uniform(0.0, 0.9)) / source.fps  # a phone's clock starts before its first frame
        # The first and the last frame are there, so that a drop is never an early end.
        kept = [i for i in range(first, len(source)) if i in (first, len(source) - 1) or g.random() >= DROPPED]
        jitter = g.normal(0, JITTER_SECONDS, len(kept)).clip(-3 * JITTER_SECONDS, 3 * JITTER_SECONDS)
        stamps = np.maximum(np.array(kept) / source.fps - zero + jitter, 0.0)
        distance = float(np.linalg.norm(source.rig[name].center.numpy() - np.asarray(place))) * metres
        heard = clap + distance / SPEED_OF_SOUND - zero
        found[name] = Phone(zero, turns[number % len(turns)], tuple(kept), tuple(stamps.tolist()), heard)
    return found


def sound(phone: Phone, *, seconds: float, seed: int) -> NDArray[np.float32]:
    """Mono samples of a microphone from its zero on: noise, and a burst that dies away."""
    g = np.random.default_rng(seed)
    samples = g.normal(0, ROOM_NOISE, round(seconds * SAMPLE_RATE))
    burst = np.random.default_rng(0).normal(0, 0.4, round(CLAP_SECONDS * 5 * SAMPLE_RATE))  # the same for all phones
    times = np.arange(len(samples)) / SAMPLE_RATE - phone.clap_seconds
    own = np.arange(len(burst)) / SAMPLE_RATE
    samples += np.interp(times, own, burst * np.exp(-own / CLAP_SECONDS), left=0, right=0)
    return samples.clip(-1, 1).astype(np.float32)


@dataclass(frozen=True)
class ThereAndBack(SourceWrapper):
    """The frames of a short capture, then the same backwards, so that it lasts as long as clocks need."""

    def __len__(self) -> int:
        return 2 * len(self.source) - 1

    def frames(self, start: int = 0) -> Iterator[MultiViewFrame]:
        there = list(self.source.frames())
        for index, frame in enumerate([*there, *there[-2::-1]]):
            if index >= start:
                yield MultiViewFrame(index, index / self.fps, frame.images)


class PhoneVideo:
    """Writes one phone's file.

    Args:
        path: to write, ``.mp4`` or ``.mov``.
        phone: what it does.
        size: width and height of the shown pictures.
        fps: frames a second that the container states.
        heard: its sound; None for no microphone.
    """

    def __init__(
        self, path: Path, phone: Phone, *, size: tuple[int, int], fps: float, heard: NDArray[np.float32] | None
    ) -> None:
        if min(size) < MIN_SIDE or size[0] % 2 or size[1] % 2:
            raise ValueError(f"pictures of {size[0]}x{size[1]}; x265 needs even sides of {MIN_SIDE} or more")
        self._phone, self._heard = phone, heard
        # In the usual timescale of 1000 a file's first frame would be rounded to a millisecond.
        self._container = av.open(str(path), "w", options={"movie_timescale": str(TIME_BASE.denominator)})
        rate = Fraction(fps).limit_denominator(1001)
        self._video = self._container.add_stream("libx265", rate=rate, options={"crf": "16", "preset": "fast"})
        self._video.width, self._video.height = size if phone.quarter_turns % 2 == 0 else size[::-1]
        self._video.pix_fmt = "yuv420p10le"
        context = self._video.codec_context
        context.codec_tag = "hvc1"
        context.time_base = self._video.time_base = TIME_BASE
        context.options = {**context.options, "x265-params": "log-level=error:pools=none:frame-threads=1"}
        state_bt709(context)
        if phone.quarter_turns:
            self._video.set_display_rotation(90 * phone.quarter_turns)
        self._audio = None
        if heard is not None:
            self._audio = self._container.add_stream("aac", rate=SAMPLE_RATE, layout="mono")
            self._audio.codec_context.bit_rate = 128_000

    def write(self, index: int, shown: Picture) -> None:
        """Adds the capture's frame ``index``, unless the phone lacks it."""
        if index not in self._phone.frames:
            return
        stored = np.ascontiguousarray(np.rot90(shown, -self._phone.quarter_turns))
        frame = bt709_frame(stored, pixels="yuv420p10le")
        stamp = self._phone.stamps[self._phone.frames.index(index)]
        frame.pts, frame.time_base = round(stamp / TIME_BASE), TIME_BASE
        self._container.mux(self._video.encode(frame))

    def close(self) -> None:
        """Ends the pictures, then writes the sound."""
        self._container.mux(self._video.encode())
        if self._audio is not None and self._heard is not None:
            for start in range(0, len(self._heard), BLOCK):
                block = av.AudioFrame.from_ndarray(self._heard[None, start : start + BLOCK], "fltp", "mono")
                block.sample_rate, block.pts, block.time_base = SAMPLE_RATE, start, Fraction(1, SAMPLE_RATE)
                self._container.mux(self._audio.encode(block))
            self._container.mux(self._audio.encode())
        self._container.close()


def write_phones(source: FrameSource, folder: Path, phones: Mapping[str, Phone], *, silent: bool = False) -> None:
    """Writes ``CAMERA.mov`` of each camera and ``truth.json``."""
    folder.mkdir(parents=True, exist_ok=True)
    videos = {}
    for number, (name, phone) in enumerate(phones.items()):
        camera = source.rig[name]
        seconds = max(phone.stamps) + 0.2
        heard = None if silent else sound(phone, seconds=seconds, seed=number)
        videos[name] = PhoneVideo(
            folder / f"{name}.mov", phone, size=(camera.width, camera.height), fps=source.fps, heard=heard
        )
    for frame in source.frames():
        for name, video in videos.items():
            video.write(frame.index, frame.images[name])
    for video in videos.values():
        video.close()
    truth = {"fps": source.fps, "phones": {name: asdict(phone) for name, phone in phones.items()}}
    (folder / "truth.json").write_text(json.dumps(truth, indent=1) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--clap", type=float, default=0.45, help="when hands meet, seconds of the capture")
    parser.add_argument("--place", type=float, nargs=3, default=(0.0, 0.0, 0.0), help="where, in units of the capture")
    parser.add_argument("--metres", type=float, default=1.0, help="in a unit of the capture")
    parser.add_argument("--turns", type=int, nargs="+", default=(0, 2, 1, 3), help="quarter turns, taken in turn")
    parser.add_argument("--back", action="store_true", help="play the capture backwards, too")
    parser.add_argument("--silent", action="store_true", help="without microphones")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    source: FrameSource = open_capture(options.capture)
    source = ThereAndBack(source) if options.back else source
    phones = planned(
        source, clap=options.clap, place=options.place, metres=options.metres, seed=options.seed, turns=options.turns
    )
    write_phones(source, options.output, phones, silent=options.silent)


if __name__ == "__main__":
    main()

# SPDX-License-Identifier: Apache-2.0
"""Which sound a stream gets: a camera's, in step by that camera's clock, or a file's, in step by what both hear."""

import logging
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from structgstream.data.prepared import read_prepared, recognizes_prepared
from structgstream.data.sound import (
    SoundFile,
    camera_clock,
    camera_videos,
    has_sound,
    open_sound,
    read_audio,
    sound_stream,
    start_seconds,
)
from structgstream.data.source import FrameSource
from structgstream.data.timeline import Clock
from structgstream.errors import CaptureError, ConfigError
from structgstream.opus import SAMPLE_RATE
from structgstream.preparation.synchronization.audio import PairLag, UnusableSoundError, audio_lags, sound_of

log = logging.getLogger(__name__)

LEVEL_SECONDS = 0.05
LOUD, QUIET = 95, 10
"""Percentiles of the level: how far what happens stands out from the noise is their difference."""
CLIPPED_AT, CLIPPED_SHARE, CLIPPED_DECIBELS = 0.99, 1e-4, 20.0
"""A microphone of which more than this share of samples is this large is overdriven, and counts as that much worse."""
DRIFT_SECONDS = 60.0
"""Instants that both hear must lie this far apart for the rate of a file's clock; nearer ones give an offset alone."""
MAX_HEARING = 4
"""Cameras that hear a file, after which no more are compared with it."""
AUTO, NONE = "auto", "none"


def loudness(samples: NDArray[np.float32]) -> float | None:
    """Decibels by which what happens stands out from the noise in a recording ``[N]``; None for silence."""
    length = round(LEVEL_SECONDS * SAMPLE_RATE)
    count = len(samples) // length
    if count < 2 or not np.ptp(samples) > 0:
        return None
    blocks = samples[: count * length].reshape(count, length)
    # Without a copy of the samples, which of two hours takes gigabytes.
    powers = np.einsum("bn,bn->b", blocks, blocks, dtype=np.float64) / length
    clips = np.count_nonzero(blocks >= CLIPPED_AT) + np.count_nonzero(blocks <= -CLIPPED_AT)
    low, high = np.percentile(10 * np.log10(np.maximum(powers, 1e-10)), [QUIET, LOUD])
    clipped = clips / (count * length) > CLIPPED_SHARE
    return float(high - low) - CLIPPED_DECIBELS * clipped


def best_microphone(recordings: Iterable[tuple[str, NDArray[np.float32] | None]]) -> str | None:
    """The camera in whose sound most stands out from the noise, without being overdriven; None if all are silent.

    Args:
        recordings: names of cameras and their samples ``[N]``, or None without sound; read one after the other.
    """
    heard: dict[str, float] = {}
    for name, samples in recordings:
        if samples is not None and (level := loudness(samples)) is not None:
            heard[name] = level
        del samples  # before the next is read
    return max(heard, key=lambda name: heard[name]) if heard else None


def recording(video: Path) -> NDArray[np.float32] | None:
    """Samples ``[N]`` of a camera's video; None where it has no sound, or, with a warning, one that cannot be read."""
    try:
        return read_audio(video)
    except CaptureError as error:
        log.warning("A camera's sound is left out: %s", error)
        return None


def chosen_sound(
    source: FrameSource, folder: Path, choice: str | None, *, offset_seconds: float | None = None
) -> SoundFile | None:
    """The sound of a run; None for none.

    Args:
        source: the frames of the run.
        folder: of their capture.
        choice: name of a camera, a file, ``auto`` for the best microphone, ``none``; None for what ``prepare`` chose.
        offset_seconds: when a file begins, in seconds after the first frame of the whole capture; None to find it out.

    Raises:
        CaptureError: there is no such sound.
        ConfigError: a camera's sound with an offset.
    """
    videos = camera_videos(source)
    prepared = read_prepared(folder).sound if recognizes_prepared(folder) else None
    if choice is None:
        choice = prepared if prepared in videos else NONE
    if choice == NONE:
        return None
    if choice == AUTO:
        choice = prepared or best_microphone((name, recording(path)) for name, path in videos.items())
        if choice is None:
            raise CaptureError(f"No camera of {folder} has sound; give a file with --sound.")
    path = Path(choice).expanduser()
    if choice in source.rig.cameras:
        if offset_seconds is not None:
            raise ConfigError(f"The sound of camera {choice!r} is in step by its clock, so it takes no --sound-offset.")
        return camera_sound(source, choice)
    if not path.is_file():
        heard = [name for name, video in videos.items() if has_sound(video)]
        cameras = f"the cameras with sound are {', '.join(heard)}" if heard else "no camera has sound"
        raise CaptureError(
            f"There is neither a camera nor a file {choice}; {cameras}, and --sound takes any file with sound, too."
        )
    return file_sound(source, path, offset_seconds=offset_seconds)


def camera_sound(source: FrameSource, camera: str) -> SoundFile:
    """The sound of a camera, shifted by its clock.

    Raises:
        CaptureError: it has none.
    """
    found = camera_clock(source, camera)
    if found is None:
        raise CaptureError(f"Camera {camera!r} has pictures and no video, so it has no sound; choose another.")
    with open_sound(found[0]) as container:
        sound_stream(container, found[0])
    return SoundFile(camera, *found)


def file_sound(source: FrameSource, path: Path, *, offset_seconds: float | None = None) -> SoundFile:
    """The sound of a file.

    Args:
        offset_seconds: see :func:`chosen_sound`.

    Raises:
        CaptureError: it has none, or cannot be read.
    """
    with open_sound(path) as container:
        sound_stream(container, path)
        begins = max(container.start_time or 0, 0) / 1e6  # MPEG-TS does not begin at 0
    start = start_seconds(source) - begins
    if offset_seconds is not None:
        return SoundFile(path.name, path, Clock(start + offset_seconds))
    clock = _clock_by_cameras(source, path)
    if clock is None:
        log.warning(
            "No camera hears what is in %s, so it is taken to begin with the first frame of the capture; "
            "--sound-offset SECONDS gives another time",
            path,
        )  # fmt: skip
        clock = Clock(start)
    else:
        log.info("%s begins %+.3f s after the first frame, by what cameras hear", path, clock.offset_seconds - start)
    return SoundFile(path.name, path, clock)


def _clock_by_cameras(source: FrameSource, path: Path) -> Clock | None:
    """The clock of a file by the sound of cameras; None where they do not hear the same."""
    samples = read_audio(path)
    if samples is None:
        return None
    clocks: list[Clock] = []
    for name, video in camera_videos(source).items():
        own = recording(video)
        camera = camera_clock(source, name)
        if own is None or camera is None:
            continue
        try:
            sounds = {name: sound_of(name, own), FILE: sound_of(FILE, samples)}
        except UnusableSoundError:
            continue
        clocks += [_clock_of(lag, camera[1]) for lag in audio_lags(sounds) if lag.fine or not clocks]
        if len(clocks) == MAX_HEARING:
            break
    if not clocks:
        return None
    return sorted(clocks, key=lambda clock: clock.offset_seconds)[len(clocks) // 2]


FILE = " file"
"""In place of a camera's name; a camera's has no blank in front."""


def _clock_of(lag: PairLag, camera: Clock) -> Clock:
    """The clock of a file from what it shares with a camera."""
    at, apart = np.array(lag.instants).T
    own, common = at + apart, camera.common_seconds(at)
    rate = 1.0
    if np.ptp(own) > DRIFT_SECONDS:
        rate = float(np.polyfit(own - own.mean(), common - common.mean(), 1)[0])
    return Clock(float(np.mean(common - rate * own)), rate)

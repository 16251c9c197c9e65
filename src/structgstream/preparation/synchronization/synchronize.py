# SPDX-License-Identifier: Apache-2.0
"""Synchronises the files of still cameras that run freely."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Literal

import numpy as np

from structgstream.data.calibration import listed
from structgstream.data.lenses import LensCamera
from structgstream.data.timeline import Clock, counted_rate, period_seconds
from structgstream.errors import CaptureError, ConfigError, import_extra
from structgstream.geometry import Floats
from structgstream.opus import SAMPLE_RATE
from structgstream.preparation.footage import Footage
from structgstream.preparation.synchronization.audio import (
    SPEED_OF_SOUND,
    UnusableSoundError,
    audio_lags,
    connected_by,
    solve_by_audio,
    sound_of,
)
from structgstream.preparation.synchronization.motion import (
    CalibratedGeometry,
    Geometry,
    StaticGeometry,
    pair_signals,
    picture_changes,
    solve_by_motion,
    static_features,
)
from structgstream.preparation.synchronization.stated_clocks import StatedClock, read_timestamps, wall_clocks

WARNED_SECONDS = 5e-3


@dataclass(frozen=True)
class Synchronization:
    """The clocks of all cameras."""

    clocks: Mapping[str, Clock]
    """Camera to its clock, from the camera's stamps to common time: the time of the first camera, or of the clock that
    a table or the files state."""
    uncertainty_seconds: Mapping[str, float]
    """Camera to the standard error of its common times, relative to the mean of all cameras."""
    method: str  # how they were found: ``csv``, ``stamps``, ``audio``, ``motion`` or ``none``
    reason: str  # why this method was chosen, a sentence
    warnings: tuple[str, ...]  # what the user should know, sentences


def synchronization(
    stamps: Mapping[str, Floats],
    clocks: Mapping[str, Clock],
    uncertainties: Mapping[str, float],
    *,
    method: str,
    reason: str,
    warnings: tuple[str, ...] = (),
) -> Synchronization:
    """The result, with what remains after choosing nearest frames."""
    common = {name: clocks[name].common_seconds(own) for name, own in stamps.items()}
    _require_overlap(common)
    residuals = frame_residuals(common)
    if late := [name for name in stamps if abs(residuals[name]) > WARNED_SECONDS]:
        worst = max(late, key=lambda name: abs(residuals[name]))
        warnings += (
            f"Nearest frames of {listed(late, 8)} are up to {abs(residuals[worst]) * 1e3:.1f} ms off the common "
            f"instants (camera {worst!r}): what moves fast is seen elsewhere there. Cameras that start by one signal "
            "have no such rest.",
        )
    if vague := [name for name in stamps if uncertainties[name] > period_seconds(stamps[name]) / 4]:
        warnings += (
            f"The clocks of {listed(vague, 8)} are known to {max(uncertainties[name] for name in vague) * 1e3:.0f} ms "
            "only, so a frame may be wrong by one.",
        )
    return Synchronization(clocks, uncertainties, method, reason, warnings)


def frame_residuals(common: Mapping[str, Floats]) -> dict[str, float]:
    """For each camera by how much its nearest frames are late, at worst: the misalignment that choosing frames leaves.

    ``common`` are the common seconds ``[T]`` of each camera's frames. The instants have the rate of the slowest camera
    and the phase that suits all cameras best.
    """
    period = 1 / (counted_rate(list(common.values())) or 30.0)  # one frame a camera: any rate is right
    start = max(times[0] for times in common.values())
    end = min(times[-1] for times in common.values())
    inside = {name: own[(own >= start - 1e-9) & (own <= end + 1e-9)] for name, own in common.items()}
    turns = [
        np.exp(2j * np.pi * (inside[name] if len(inside[name]) else common[name]) / period).mean() for name in common
    ]
    phase = float(np.angle(np.sum(turns))) / (2 * np.pi) * period
    first = np.ceil((start - phase) / period - 0.5)
    instants = phase + period * np.arange(first, first + max(int((end - start) / period), 1))
    residuals = {}
    for name, times in common.items():
        nearest = np.clip(np.searchsorted(times, instants), 1, len(times) - 1) if len(times) > 1 else np.zeros(1, int)
        before = np.maximum(nearest - 1, 0)
        chosen = np.where(np.abs(times[before] - instants) < np.abs(times[nearest] - instants), before, nearest)
        late = times[chosen] - instants
        # A frame that a camera lacks is absent, not late.
        late = late[np.abs(late) <= period / 2 + 1e-9]
        residuals[name] = float(late[np.abs(late).argmax()]) if len(late) else 0.0
    return residuals


def _require_overlap(common: Mapping[str, Floats]) -> None:
    for first, second in combinations(common, 2):
        one, other = common[first], common[second]
        if one[-1] < other[0] or other[-1] < one[0]:
            raise CaptureError(
                f"Cameras {first!r} ({one[-1] - one[0]:.2f} s) and {second!r} ({other[-1] - other[0]:.2f} s) have "
                f"no instant in common: their clocks are {abs(one[0] - other[0]):.2f} s apart, more than the shorter "
                "video is long. Give videos of one take, all running before it begins."
            )


_log = logging.getLogger(__name__)
Method = Literal["auto", "csv", "stamps", "audio", "motion", "none"]
METHODS: tuple[Method, ...] = ("auto", "csv", "stamps", "audio", "motion", "none")

SOUND_SPREAD_METRES = 1.0  # standard deviation of the cameras' distances from the sound
STATIC_PICTURES = 9
MOTION_SECONDS = 60.0  # of the beginning of each take, in which motion is compared


def synchronize(
    footage: Footage,
    *,
    method: Method = "auto",
    timestamps: Path | None = None,
    cameras: Mapping[str, LensCamera] | None = None,
) -> Synchronization:
    """The clocks of the cameras.

    Args:
        method: ``csv`` (``timestamps``), ``stamps`` (of the files, which share a clock), ``audio``, ``motion``,
            ``none`` (the cameras were started by one signal: stamps hold as they are), or ``auto``: csv if given,
            else audio if all cameras have sound in which something is common, else motion.
        timestamps: a table of times (``stated_clocks.py``).
        cameras: the calibration, if it is known; motion is exact with it and coarse without.

    Raises:
        CaptureError: the cameras cannot be synchronised so; the message names camera and reason.
        ConfigError: ``method`` is unknown, or csv without a table.
    """
    if method not in METHODS:
        raise ConfigError(f"The method of synchronisation must be one of {', '.join(METHODS)}, got {method!r}.")
    if method == "csv" and timestamps is None:
        raise ConfigError(
            "Synchronisation by csv needs timestamps.csv with the columns camera,frame,seconds beside the videos."
        )
    stamps = {name: np.asarray(footage.stamps(name), np.float64) for name in footage.cameras}
    for name, own in stamps.items():
        if not len(own):
            raise CaptureError(f"Camera {name!r} has no frames; add them or remove the camera.")
    if timestamps is not None and method in ("auto", "csv"):
        table = read_timestamps(timestamps, stamps)
        return _stated(stamps, table, method="csv", reason=f"{timestamps.name} states times")
    if method == "none":
        given = dict.fromkeys(stamps, StatedClock(Clock(), 0.0, "none"))
        return _stated(stamps, given, method="none", reason="the cameras are said to be synchronous")
    if method == "stamps":
        found = wall_clocks(stamps, {name: footage.metadata(name) for name in stamps})
        reason = f"stamps of the files ({next(iter(found.values())).kind}) are said to share a clock"
        return _stated(stamps, found, method="stamps", reason=reason)
    import_extra("scipy", "capture")
    if method == "motion":
        return _by_motion(footage, stamps, cameras, "motion was requested")
    if method == "audio":
        return _by_audio(footage, stamps, "audio was requested")
    return _automatic(footage, stamps, cameras)


def _automatic(
    footage: Footage, stamps: Mapping[str, Floats], cameras: Mapping[str, LensCamera] | None
) -> Synchronization:
    try:
        return _by_audio(footage, stamps, "all cameras have sound")
    except CaptureError as problem:
        unusable = problem.reason if isinstance(problem, UnusableSoundError) else str(problem).rstrip(".")
    reason = f"sound cannot be used ({unusable})"
    _log.info("synchronised by motion: %s", reason)
    try:
        return _by_motion(footage, stamps, cameras, reason)
    except CaptureError as problem:
        raise CaptureError(f"{problem} Nor can sound be used: {unusable}.") from None


def _stated(
    stamps: Mapping[str, Floats], found: Mapping[str, StatedClock], *, method: str, reason: str
) -> Synchronization:
    clocks, sigmas = ({name: getattr(own, key) for name, own in found.items()} for key in ("clock", "sigma_seconds"))
    return synchronization(stamps, clocks, sigmas, method=method, reason=reason)


def _by_audio(footage: Footage, stamps: Mapping[str, Floats], reason: str) -> Synchronization:
    recorded = {name: footage.audio(name) for name in stamps}
    mute = next((name for name, sound in recorded.items() if sound is None), None)
    if mute is not None:
        raise UnusableSoundError(f"Camera {mute!r} has no sound", "synchronise by motion or timestamps.csv")
    sounds = {name: sound_of(name, sound) for name, sound in recorded.items() if sound is not None}
    lags = audio_lags(sounds)
    takes = {name: (0.0, len(sound.samples) / SAMPLE_RATE) for name, sound in sounds.items()}
    groups = connected_by(list(takes), lags)
    if len(groups) > 1:
        others = ", ".join(repr(name) for group in groups[1:] for name in group)
        raise UnusableSoundError(
            f"The sound of {others} has nothing in common with that of {groups[0][0]!r}: no lag stands out, or the "
            "videos are shorter than the time between their starts",
            "film a clap that all hear, or synchronise by motion or timestamps.csv",
        )
    solution = solve_by_audio(takes, lags)
    return synchronization(
        stamps,
        {name: Clock(solution.offsets[name], solution.rates[name]) for name in stamps},
        {name: float(np.hypot(solution.sigmas[name], SOUND_SPREAD_METRES / SPEED_OF_SOUND)) for name in stamps},
        method="audio",
        reason=reason,
        warnings=(
            f"Sound takes {1e3 / SPEED_OF_SOUND:.1f} ms a metre, and the distances of the cameras from it are not "
            "known: clap in the middle of the cameras.",
        ),
    )


def _by_motion(
    footage: Footage, stamps: Mapping[str, Floats], cameras: Mapping[str, LensCamera] | None, reason: str
) -> Synchronization:
    used = {name: own[own <= own[0] + MOTION_SECONDS] for name, own in stamps.items()}
    changes = {name: picture_changes(footage.pictures(name, np.arange(len(own))), own) for name, own in used.items()}
    if still := [name for name, change in changes.items() if not change.moving]:
        raise CaptureError(
            f"Too little moves in the pictures of {', '.join(map(repr, still))} to synchronise by motion; film people "
            f"who move in the first {MOTION_SECONDS:g} s, a clap for audio, or give timestamps.csv."
        )
    geometry: Geometry = CalibratedGeometry(cameras) if cameras else _static_geometry(footage, used)
    period = max(period_seconds(own) for own in stamps.values())
    takes = {name: (float(own[0]), float(own[-1])) for name, own in used.items()}
    solution = solve_by_motion(takes, pair_signals(changes, geometry), slack_seconds=period / 2, drift=True)
    return synchronization(
        stamps,
        {name: Clock(solution.offsets[name], solution.rates[name]) for name in stamps},
        solution.sigmas,
        method="motion",
        reason=reason,
        warnings=() if cameras else ("Motion was compared without calibration: synchronise again when it is known.",),
    )


def _static_geometry(footage: Footage, stamps: Mapping[str, Floats]) -> StaticGeometry:
    features = {}
    for name, own in stamps.items():
        indices = np.unique(np.linspace(0, len(own) - 1, STATIC_PICTURES).round().astype(int))
        features[name] = static_features(list(footage.pictures(name, indices)))
    return StaticGeometry(features, {name: footage.size(name) for name in stamps})

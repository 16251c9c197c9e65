# SPDX-License-Identifier: Apache-2.0
"""Whether pictures of one frame are of one moment: motion under the epipolar geometry of the calibration shows by
how much each camera is late."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from structgstream.data.calibration import listed
from structgstream.data.lenses import LensCamera, Pinhole
from structgstream.data.source import FrameSource, apart_seconds
from structgstream.errors import import_extra
from structgstream.pose_check.check import Finding
from structgstream.preparation.synchronization.motion import (
    CalibratedGeometry,
    Changes,
    agreeing_cameras,
    pair_signals,
    reduced_changes,
    reduced_grey,
    solve_by_motion,
)
from structgstream.preparation.synchronization.synchronize import WARNED_SECONDS

LESS_THAN_A_FRAME = (
    "less than a frame, which choosing frames cannot mend; what moves fast will blur there. Cameras that one signal "
    "starts have no such rest."
)
OFF_PERIODS = 0.25  # of a camera's frames, from which on it is off; true synchronous captures show up to 0.16
MAX_SIGMA_PERIODS = 1 / 3  # so that a whole frame shows
FRAMES = 90  # that are compared
MIN_FRAMES = 20
"""Fewer are not judged: by the twelve of the synchronous `examples/throw` two cameras seem late by most of a frame."""
SIGMAS, SURE_SIGMAS = 3.0, 2.0


@dataclass(frozen=True)
class SynchronizationCheck:
    """Result of the check."""

    late_seconds: Mapping[str, float]
    """Camera to how much later than stated its pictures were taken, relative to most cameras; of the cameras that can
    be judged. Stated are their own time stamps, where the capture has them."""
    uncertainty_seconds: Mapping[str, float]  # the standard errors of these
    off: tuple[str, ...]
    """Cameras that are late or early by more than a quarter of a frame period, and more than chance."""
    undecided: tuple[str, ...]  # cameras in whose pictures too little moves that others see
    period_seconds: float  # the frame period
    apart_seconds: Mapping[str, float] = field(default_factory=dict)
    """Camera to how long after their instants its pictures were taken by their time stamps, relative to most cameras;
    empty where the capture has no time stamps."""
    still: tuple[str, ...] = ()
    """Cameras in whose pictures nothing changes, where it does in those of most; of ``undecided``."""

    @property
    def between(self) -> dict[str, float]:
        """Of :attr:`apart_seconds` those that count: cameras whose pictures lie between the instants of the others."""
        return {name: lateness for name, lateness in self.apart_seconds.items() if abs(lateness) > WARNED_SECONDS}

    @property
    def late_against_others(self) -> dict[str, float]:
        """How much later than those of most cameras pictures of a frame were taken: what time stamps state, and what
        they do not; of the cameras that can be judged."""
        return {name: late + self.apart_seconds.get(name, 0.0) for name, late in self.late_seconds.items()}

    @property
    def conclusive(self) -> bool:
        """Whether at least half of the cameras, and at least two, can be judged."""
        return len(self.late_seconds) >= max(2, len(self.undecided))


def check_synchronization(source: FrameSource) -> SynchronizationCheck:
    """By how much each camera of a calibrated capture is late, from its first frames.

    Held-out cameras are checked, too: nothing is fitted to their pictures.
    """
    import_extra("scipy", "capture")
    period = 1 / source.fps
    changes = _changes(source)
    cameras = {name: LensCamera(source.rig[name], Pinhole()) for name in source.rig}
    pairs = pair_signals(changes, CalibratedGeometry(cameras))
    pairs = [pair for pair in pairs if pair.epipolar]
    takes = {name: (float(own.times[0]), float(own.times[-1])) for name, own in changes.items() if len(own.times)}
    group, coarse, good = agreeing_cameras(takes, pairs, slack_seconds=period / 2) if pairs else ((), None, [])
    lateness = _stated_lateness(source)
    still = tuple(name for name, own in changes.items() if len(own.times) > 1 and not own.moving)
    still = still if 2 * len(still) < len(changes) else ()
    if coarse is None:
        return SynchronizationCheck({}, {}, (), tuple(source.rig), period, lateness, still)
    solution = solve_by_motion({name: takes[name] for name in group}, good, slack_seconds=period / 2, drift=False)
    middle = float(np.median(list(solution.offsets.values())))
    # A clock that is uncertain by a good part of a frame is not judged, however far it is from the others.
    judged = tuple(name for name in group if solution.sigmas[name] <= MAX_SIGMA_PERIODS * period)
    late = {name: solution.offsets[name] - middle for name in judged}
    errors = {name: solution.sigmas[name] for name in judged}
    off = tuple(name for name in judged if abs(late[name]) > max(OFF_PERIODS * period, SIGMAS * errors[name]))
    undecided = tuple(name for name in source.rig if name not in judged)
    return SynchronizationCheck(late, errors, off, undecided, period, lateness, still)


def _changes(source: FrameSource) -> dict[str, Changes]:
    reduced: dict[str, list[NDArray[np.uint8]]] = {name: [] for name in source.rig}
    stamps: dict[str, list[float]] = {name: [] for name in source.rig}
    lateness = apart_seconds(source)
    for frame in islice(source.frames(), FRAMES):
        for name, picture in frame.images.items():
            reduced[name].append(reduced_grey(picture))
            later = float(lateness[name][frame.index]) if name in lateness else 0.0
            stamps[name].append(frame.index / source.fps + later)
    sizes = {name: (source.rig[name].width, source.rig[name].height) for name in source.rig}
    return {name: reduced_changes(reduced[name], np.array(stamps[name]), sizes[name]) for name in source.rig}


def _stated_lateness(source: FrameSource) -> dict[str, float]:
    """The median over the first frames for each camera, relative to the median camera."""
    usual = {
        name: float(np.median(own))
        for name, all_ in apart_seconds(source).items()
        if name in source.rig and len(own := all_[:FRAMES][~np.isnan(all_[:FRAMES])])
    }
    middle = float(np.median(list(usual.values()))) if usual else 0.0
    return {name: lateness - middle for name, lateness in usual.items()}


def time_findings(measured: SynchronizationCheck | None) -> list[Finding]:
    """An error for a camera that is off by more than 0.6 frames and, less two standard errors, by more than half a
    frame; a warning for one that is off by more than a quarter of a frame, 5 ms and three standard errors, and for one
    in whose pictures nothing changes; a note of those that cannot be judged.

    A camera is off if its pictures show another instant than its time stamps state. Cameras whose pictures, by their
    time stamps, lie between those of the others get one warning together.
    """
    if measured is None:
        return []
    findings = [_between(measured)] if measured.between else []
    for name in measured.still:
        sentence = (
            f"Nothing changes in the pictures of camera {name!r}, but in those of most others: it froze, or it sees "
            "nothing of what moves. Look at its video; if it froze, leave the camera out."
        )
        findings.append(Finding("warning", sentence, (name,)))
    if not measured.conclusive:
        unknown = (
            "It cannot be determined whether the cameras are synchronous: too little moves that several of them see."
        )
        return [*findings, Finding("note", unknown)]
    if apart := tuple(name for name in measured.undecided if name not in measured.still):
        sentence = (
            f"It cannot be determined whether {listed(apart)} {'are' if len(apart) > 1 else 'is'} in step with the "
            "others: too little moves that they see together, or clocks are seconds apart; compare their pictures of "
            "one frame."
        )
        findings.append(Finding("note", sentence, apart))
    for name, late in measured.late_seconds.items():
        if abs(late) < max(WARNED_SECONDS, SIGMAS * measured.uncertainty_seconds[name]):
            continue
        amount = f"{1e3 * abs(late):.1f} ms ({abs(late) / measured.period_seconds:.2f} frames)"
        which = "late" if late > 0 else "early"
        # What is surely more than half a frame another choice of frames mends.
        surely = abs(late) - SURE_SIGMAS * measured.uncertainty_seconds[name]
        if abs(late) > 0.6 * measured.period_seconds and surely > 0.5 * measured.period_seconds:
            sentence = f"Camera {name!r} is {amount} {which}; synchronise again, or correct its clock in capture.json."
            findings.append(Finding("error", sentence, (name,)))
        elif name in measured.off:
            findings.append(Finding("warning", f"Camera {name!r} is {amount} {which}: {LESS_THAN_A_FRAME}", (name,)))
    return findings


def _between(measured: SynchronizationCheck) -> Finding:
    """Cameras whose pictures by their time stamps lie between those of the others."""
    names = measured.between
    worst = max(names, key=lambda name: abs(names[name]))
    lateness = names[worst]
    return Finding(
        "warning",
        f"By their time stamps the pictures of {', '.join(map(repr, names))} lie between those of the others, those of "
        f"{worst!r} {abs(lateness) * 1e3:.1f} ms ({abs(lateness) / measured.period_seconds:.2f} frames) too "
        f"{'late' if lateness > 0 else 'early'}: {LESS_THAN_A_FRAME}",
        tuple(names),
    )

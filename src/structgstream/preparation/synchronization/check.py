# SPDX-License-Identifier: Apache-2.0
"""Checks a capture that is said to be synchronous: motion under the epipolar geometry of its calibration says by how
much each camera is late."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from structgstream.data.lenses import LensCamera, Pinhole
from structgstream.data.source import FrameSource
from structgstream.preparation.synchronization.changes import Changes, reduced_changes, reduced_picture
from structgstream.preparation.synchronization.correlation import demand_scipy
from structgstream.preparation.synchronization.geometry import CalibratedGeometry
from structgstream.preparation.synchronization.motion import (
    agreeing_cameras,
    pair_signals,
    solve_by_motion,
)

OFF_PERIODS = 0.25  # of a camera's frames, from which on it is off; true synchronous captures show up to 0.16
OFF_SIGMAS = 3.0
MOST_SIGMA_PERIODS = 0.25
MOST_FRAMES = 300


@dataclass(frozen=True)
class SynchronizationCheck:
    """Result of the check.

    Args:
        late_seconds: camera to how much later than stated its pictures were taken, relative to most cameras; of the
        cameras
            that can be judged.
        uncertainty_seconds: the standard errors of these.
        off: cameras that are late or early by more than a quarter of a frame period, and more than chance.
        undecided: cameras in whose pictures too little moves that others see.
        period_seconds: the frame period.
    """

    late_seconds: Mapping[str, float]
    uncertainty_seconds: Mapping[str, float]
    off: tuple[str, ...]
    undecided: tuple[str, ...]
    period_seconds: float

    @property
    def conclusive(self) -> bool:
        """Whether at least half of the cameras, and at least two, can be judged."""
        return len(self.late_seconds) >= max(2, len(self.undecided))

    @property
    def message(self) -> str:
        """A sentence for each thing to know."""
        if not self.conclusive:
            return "It cannot be told whether the cameras are synchronous: too little moves that several of them see."
        said = [self._off_message(name) for name in self.off]
        if not said:
            worst = max(abs(late) for late in self.late_seconds.values())
            said = [f"The cameras are synchronous within {worst * 1e3:.1f} ms."]
        if self.undecided:
            names = ", ".join(repr(name) for name in self.undecided)
            said.append(f"Too little moves before {names} to tell about them.")
        return " ".join(said)

    def _off_message(self, name: str) -> str:
        late = self.late_seconds[name]
        amount = f"{abs(late) * 1e3:.1f} ms ({abs(late) / self.period_seconds:.2f} frames)"
        return f"Camera {name!r} is {amount} {'late' if late > 0 else 'early'}; shift its frames, or synchronise again."


def check_synchronization(source: FrameSource, *, frames: int = MOST_FRAMES) -> SynchronizationCheck:
    """By how much each camera of a calibrated capture is late, from its first ``frames`` frames.

    All cameras are looked at, those that are held out, too: nothing is fitted to their pictures.

    Raises:
        CaptureError: the pictures cannot be read.
        MissingExtraError: cv2 or scipy is not installed.
    """
    demand_scipy()
    period = 1 / source.fps
    changes = _changes(source, frames)
    cameras = {name: LensCamera(source.rig[name], Pinhole()) for name in source.rig}
    pairs = pair_signals(changes, CalibratedGeometry(cameras))
    pairs = [pair for pair in pairs if pair.epipolar]
    takes = {name: (float(own.times[0]), float(own.times[-1])) for name, own in changes.items() if len(own.times)}
    group, coarse, good = agreeing_cameras(takes, pairs, slack_seconds=period / 2) if pairs else ((), None, [])
    if coarse is None:
        return SynchronizationCheck({}, {}, (), tuple(source.rig), period)
    solution = solve_by_motion({name: takes[name] for name in group}, good, slack_seconds=period / 2, drift=False)
    middle = float(np.median(list(solution.offsets.values())))
    # A clock that is unsure by a good part of a frame tells nothing, however far it is from the others.
    told = tuple(name for name in group if solution.sigmas[name] <= MOST_SIGMA_PERIODS * period)
    late = {name: solution.offsets[name] - middle for name in told}
    errors = {name: solution.sigmas[name] for name in told}
    off = tuple(name for name in told if abs(late[name]) > max(OFF_PERIODS * period, OFF_SIGMAS * errors[name]))
    return SynchronizationCheck(late, errors, off, tuple(name for name in source.rig if name not in told), period)


def _changes(source: FrameSource, frames: int) -> dict[str, Changes]:
    reduced: dict[str, list[NDArray[np.uint8]]] = {name: [] for name in source.rig}
    stamps: dict[str, list[float]] = {name: [] for name in source.rig}
    for frame in islice(source.frames(), frames):
        for name, picture in frame.images.items():
            reduced[name].append(reduced_picture(picture))
            stamps[name].append(frame.index / source.fps)
    sizes = {name: (source.rig[name].width, source.rig[name].height) for name in source.rig}
    return {name: reduced_changes(reduced[name], np.array(stamps[name]), sizes[name]) for name in source.rig}

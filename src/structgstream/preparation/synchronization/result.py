# SPDX-License-Identifier: Apache-2.0
"""What synchronisation finds."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from structgstream.data.arrays import Floats
from structgstream.data.calibration import listed
from structgstream.data.timeline import Clock, counted_rate, period_seconds
from structgstream.errors import CaptureError

WARNED_SECONDS = 5e-3


@dataclass(frozen=True)
class ClockEstimate:
    """A camera's clock.

    Args:
        clock: from the camera's stamps to common time.
        method: ``csv``, ``stamps``, ``audio``, ``motion`` or ``none``.
        uncertainty_seconds: standard error of its common times, relative to the mean of all cameras.
        residual_seconds: how much later than the common instants the camera's frames are that are nearest to them: the
            misalignment that choosing frames leaves; of the frames of the take, the one with the largest amount.
    """

    clock: Clock
    method: str
    uncertainty_seconds: float
    residual_seconds: float


@dataclass(frozen=True)
class Synchronization:
    """The clocks of all cameras.

    Args:
        clocks: camera to its clock; the common clock is that of the first camera, or the one that stamps are of.
        method: how they were found.
        reason: why this method was chosen, a sentence.
        warnings: what the user should know, sentences.
    """

    clocks: Mapping[str, ClockEstimate]
    method: str
    reason: str
    warnings: tuple[str, ...]


def synchronization(
    stamps: Mapping[str, Floats],
    clocks: Mapping[str, Clock],
    uncertainties: Mapping[str, float],
    *,
    method: str,
    reason: str,
    warnings: tuple[str, ...] = (),
) -> Synchronization:
    """The result, with what remains after choosing nearest frames.

    Raises:
        CaptureError: two cameras have no instant in common.
    """
    common = {name: clocks[name].common_seconds(own) for name, own in stamps.items()}
    _require_overlap(common)
    residuals = frame_residuals(common)
    estimates = {
        name: ClockEstimate(clocks[name], method, float(uncertainties[name]), residuals[name]) for name in stamps
    }
    late = [name for name in stamps if abs(residuals[name]) > WARNED_SECONDS]
    if late:
        worst = max(late, key=lambda name: abs(residuals[name]))
        warnings += (
            f"Nearest frames of {listed(late, 8)} are up to {abs(residuals[worst]) * 1e3:.1f} ms off the common "
            f"instants (camera {worst!r}): what moves fast is seen elsewhere there. Cameras that start by one signal "
            "have no such rest.",
        )
    vague = [name for name in stamps if uncertainties[name] > period_seconds(stamps[name]) / 4]
    if vague:
        warnings += (
            f"The clocks of {listed(vague, 8)} are known to {max(uncertainties[name] for name in vague) * 1e3:.0f} ms "
            "only, so a frame may be wrong by one.",
        )
    return Synchronization(estimates, method, reason, warnings)


def frame_residuals(common: Mapping[str, Floats]) -> dict[str, float]:
    """For each camera by how much its nearest frames are late, at worst.

    Args:
        common: camera to the common seconds ``[T]`` of its frames. The instants have the rate of the slowest camera
            and the phase that suits all cameras best.
    """
    period = 1 / (counted_rate(list(common.values())) or 30.0)  # one frame a camera: any rate is right
    start = max(times[0] for times in common.values())
    end = min(times[-1] for times in common.values())
    turns = [np.exp(2j * np.pi * _inside(times, start, end) / period).mean() for times in common.values()]
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


def _inside(times: Floats, start: float, end: float) -> Floats:
    inside = times[(times >= start - 1e-9) & (times <= end + 1e-9)]
    return inside if len(inside) else times


def _require_overlap(common: Mapping[str, Floats]) -> None:
    for first, second in combinations(common, 2):
        one, other = common[first], common[second]
        if one[-1] < other[0] or other[-1] < one[0]:
            raise CaptureError(
                f"Cameras {first!r} ({one[-1] - one[0]:.2f} s) and {second!r} ({other[-1] - other[0]:.2f} s) have "
                f"no instant in common: their clocks are {abs(one[0] - other[0]):.2f} s apart, more than the shorter "
                "video is long. Give videos of one take, all running before it begins."
            )

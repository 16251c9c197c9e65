# SPDX-License-Identifier: Apache-2.0
"""Which frames of several videos belong to one instant, by time stamp.

Instants are evenly spaced. A frame serves the instant that it is nearest to, and of several frames the nearest serves
it, so that an instant is never more than half a period away and no picture is used twice. A camera whose frames all
keep one distance to the instants is moved as a whole: jitter around half a period would otherwise lose frames.
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from structgstream.data.arrays import Floats

log = logging.getLogger(__name__)

STANDARD_RATES = tuple(rate * factor for rate in (24, 25, 30, 50, 60, 120) for factor in (1.0, 1000 / 1001))
SAME_RATE = 0.02
"""Rates that differ by less than this share are one: short videos do not tell them apart."""
STEADY = 0.9
"""Length of the mean of the frames' phases as unit vectors, above which a camera keeps one distance to the instants."""
DUPLICATE = 0.5
"""Frames closer than this share of the camera's own period are two of one instant."""


@dataclass(frozen=True)
class Placed:
    """A camera's frames on the common timeline.

    Args:
        slots: ``[n]`` int64, ascending: the instants that have a frame.
        frames: ``[n]`` int64, the frame of each, counted in the video.
        errors: ``[n]``, time of the frame minus the instant, in periods.
        repeated: slots that two frames of one instant compete for, which regular videos do not have.
    """

    slots: NDArray[np.int64]
    frames: NDArray[np.int64]
    errors: Floats
    repeated: tuple[int, ...]


def place(positions: Floats) -> Placed:
    """The frames of a camera at ``positions`` ``[n]``, ascending: their times in periods, instants being integers."""
    shift = _steady_phase(positions)
    slots = np.rint(positions - shift).astype(np.int64)
    errors = positions - slots
    steps = np.diff(positions)
    close = steps < DUPLICATE * float(np.median(steps)) if len(steps) else np.zeros(0, bool)
    repeated = slots[1:][close & (slots[1:] == slots[:-1])]
    order = np.lexsort((np.abs(errors), slots))
    chosen = order[np.unique(slots[order], return_index=True)[1]]
    return Placed(slots[chosen], chosen.astype(np.int64), errors[chosen], tuple(map(int, repeated)))


def _steady_phase(positions: Floats) -> float:
    """The distance in periods, within half a one, that all frames keep to the instants; 0 if they do not."""
    mean = np.exp(2j * np.pi * positions).mean()
    return float(np.angle(mean) / (2 * np.pi)) if abs(mean) > STEADY else 0.0


def origin_of(positions: Sequence[Floats]) -> float:
    """The instant 0 in periods, such that cameras' first frames lie around instants."""
    origin = min(float(own[0]) for own in positions)
    phases = np.array([float(own[0]) - origin for own in positions])
    # Phases are circular: 0.45 and -0.45 are neighbours.
    middle = np.angle(np.exp(2j * np.pi * phases).mean()) / (2 * np.pi)
    apart = phases - middle
    return origin + float(middle + np.median(apart - np.rint(apart)))


def measured_rate(seconds: Sequence[Floats]) -> float | None:
    """Frames a second of cameras by their time stamps, each ascending; None if no camera has two frames.

    It is robust to missing frames and exact for usual rates. Of different rates it is the lowest.
    """
    rate = counted_rate(seconds)
    if rate is None:
        return None
    usual = min(STANDARD_RATES, key=lambda standard: abs(standard - rate))
    return usual if abs(usual / rate - 1) < 3e-4 else rate


def counted_rate(seconds: Sequence[Floats]) -> float | None:
    """As :func:`measured_rate`, but what is close to a usual rate is not taken for it.

    Frames are counted over the whole take: the median of steps that jitter is not their mean, and instants at such a
    rate would leave the frames.
    """
    rates = []
    for own in seconds:
        if len(own) < 2:
            continue
        steps = np.diff(own)
        # A long step stands for missing frames, a short one is jitter.
        frames = np.maximum(np.rint(steps / max(float(np.median(steps)), 1e-9)), 1).sum()
        rates.append(float(frames / (own[-1] - own[0])))
    if not rates:
        return None
    rate = float(np.median(rates))
    if any(abs(other / rate - 1) > SAME_RATE for other in rates):
        rate = float(np.median([other for other in rates if other / min(rates) - 1 <= SAME_RATE]))
    return rate


def tell_time_error(placed: Mapping[str, Placed], slots: range, *, fps: float, where: str) -> None:
    """States the largest distance of a picture to its instant, with a warning above 5 ms."""
    worst = {}
    for name, own in placed.items():
        inside = (own.slots >= slots.start) & (own.slots < slots.stop)
        worst[name] = 1e3 * float(np.abs(own.errors[inside]).max(initial=0.0)) / fps
    camera = max(worst, key=lambda name: worst[name])
    text = "%s: pictures lie up to %.1f ms from their instants (camera %r)"
    if worst[camera] > 5:
        log.warning(text + "; what moves fast will not agree between cameras", where, worst[camera], camera)
    else:
        log.info(text, where, worst[camera], camera)

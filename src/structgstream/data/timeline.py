# SPDX-License-Identifier: Apache-2.0
"""The time steps of a capture: which pictures are of one instant, and which cameras lack one.

Instants are evenly spaced. A video's frame belongs to the nearest instant, and of several frames the nearest is used,
so that an instant is never more than half a period away and no picture is used twice. A camera whose frames all have
one distance to the instants is shifted as a whole: jitter around half a period would otherwise lose frames. Pictures
are matched by the numbers in their names.
"""

import logging
import math
import re
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from structgstream.errors import CaptureError, ConfigError
from structgstream.frames import MIN_CAMERAS
from structgstream.geometry import Floats, Indices

log = logging.getLogger(__name__)

MAX_SINGLE = 2
"""Maximum number of cameras that lack frames with a line each; more are listed in one line."""


def period_seconds(stamps: NDArray[np.float64]) -> float:
    """The usual time in seconds between two frames at ``stamps`` ``[T]``; 1/30 s for a single one."""
    return float(np.median(np.diff(stamps))) if len(stamps) > 1 else 1 / 30


def check_rate(fps: float) -> None:
    """Check a number of frames a second.

    Raises:
        ConfigError: it is not positive, or not finite.
    """
    if not 0 < fps < math.inf:
        raise ConfigError(f"Frames a second must be positive, got {fps:g}.")


@dataclass(frozen=True)
class Clock:
    """A camera's clock: common time = ``offset_seconds`` + ``rate`` * time stamp in seconds."""

    offset_seconds: float = 0.0
    rate: float = 1.0

    def common_seconds(self, stamps: NDArray[np.float64]) -> NDArray[np.float64]:
        """Times of time stamps (seconds) on the common clock, seconds."""
        return self.offset_seconds + self.rate * stamps


NUMBER = re.compile(r"((?<!\d)1\d{9}\.\d+|\d+)")
"""A number in a name: whole, or seconds since 1970 with decimals, of which ``str`` leaves out the last zeros. A frame's
number may follow a date (``20220101120000.2``), which has other digits."""


def natural(text: str) -> tuple[tuple[int, int, str], ...]:
    """Sort key that puts ``cam2`` before ``cam10``."""
    parts = [part for part in NUMBER.split(text) if part]
    return tuple((0, int(part.split(".")[0]), part) if part[0].isdecimal() else (1, 0, part) for part in parts)


def instants_of(stems: Mapping[str, Sequence[str]]) -> dict[str, dict[str, str]]:
    """By camera and name of a picture, a key of its instant that all cameras share.

    Numbers are compared whatever their padding. Where a camera then shares no name with another and its names differ in
    one number alone, that number counts, whatever stands around it (``00_00_00000012``, ``000012_left``).
    """
    keys = {}
    for name, own in stems.items():
        unpadded = {stem: NUMBER.sub(lambda found: _unpadded(found[0]), stem) for stem in own}
        keys[name] = unpadded if len({*unpadded.values()}) == len(own) else {stem: stem for stem in own}
    taken = Counter(key for own in keys.values() for key in own.values())
    if len(keys) < 2 or all(any(taken[key] > 1 for key in own.values()) for own in keys.values()):
        return keys
    numbered = {name: _running_numbers(own) for name, own in stems.items()}
    if not all(numbered.values()):
        return keys
    words = {name: re.sub(r"[\W\d_]+", "", own[0].replace(name, "")) for name, own in stems.items()}
    first = next(iter(words))
    if other := next((name for name in words if words[name] != words[first]), None):
        log.warning(
            "The pictures of cameras %r (%s) and %r (%s) have other names, and are matched by their numbers alone; if "
            "these are not of one count, name pictures of one instant alike",
            first, stems[first][0], other, stems[other][0],
        )  # fmt: skip
    return numbered


def _unpadded(number: str) -> str:
    return number.rstrip("0") if "." in number else str(int(number))


def _running_numbers(stems: Sequence[str]) -> dict[str, str]:
    """The number in each name that counts, where the names differ in nothing else; else nothing."""
    parts = [re.split(r"(\d+)", stem) for stem in stems]
    if len({len(own) for own in parts}) != 1:
        return {}
    differing = [place for place, column in enumerate(zip(*parts)) if len(set(column)) > 1]
    if len(stems) == 1:
        differing = [len(parts[0]) - 2]
    if len(differing) != 1 or differing[0] % 2 == 0 or differing[0] < 0:
        return {}
    numbers = {stem: str(int(own[differing[0]])) for stem, own in zip(stems, parts)}
    return numbers if len(set(numbers.values())) == len(stems) else {}


def picture_slots(pictures: Mapping[str, Sequence[Path]]) -> dict[str, Indices]:
    """Which instant each picture of each camera is of, ``[N]`` from 0 on, ascending; pictures are in :func:`natural`
    order.

    Cameras that share instants (:func:`instants_of`) number their pictures alike, so one that lacks a name lacks that
    instant. Where a camera shares none with any other, each numbers as it likes, and pictures are counted.
    """
    keys = instants_of({name: [file.stem for file in files] for name, files in pictures.items()})
    stems = {name: [keys[name][file.stem] for file in files] for name, files in pictures.items()}
    taken = Counter(stem for own in stems.values() for stem in own)
    if not all(any(taken[stem] > 1 for stem in own) for own in stems.values()):
        return {name: np.arange(len(own)) for name, own in stems.items()}
    slot_of = {stem: slot for slot, stem in enumerate(sorted(taken, key=natural))}
    return {name: np.array([slot_of[stem] for stem in own]) for name, own in stems.items()}


Slots = Mapping[str, Sequence[int]]
"""By camera the slots it has, ascending; a slot is one instant of the common timeline."""


def common_slots(slots: Slots, *, where: str, label: Callable[[int], str], training: Collection[str]) -> range:
    """The range of slots of a capture, of which cameras may lack some.

    It begins where the last camera begins, and ends where most cameras have ended: with the last slot that at least
    half of the cameras, and two of those for training, reach. Cameras are absent from the slots in between that they
    lack. Frames that are left out and absent cameras are logged, a camera that lacks frames with a line of its own, or
    in one line with the others if more than :data:`MAX_SINGLE` do.

    Args:
        label: names the instant of a slot, for messages ("at 0.133 s", "000017").
        training: names of the cameras that are not held out.

    Raises:
        CaptureError: a camera without frames, no frames in common, or two frames of a camera for one slot.
    """
    for camera, own in slots.items():
        if not own:
            raise CaptureError(f"Camera {camera!r} of {where} has no frames; add them or remove the camera.")
    late = max(slots, key=lambda camera: slots[camera][0])
    first, last = slots[late][0], _end(slots, training)
    inside = {camera: [slot for slot in own if first <= slot <= last] for camera, own in slots.items()}
    if lost := [camera for camera, own in inside.items() if not own]:
        early = min(slots, key=lambda camera: slots[camera][-1]) if lost[0] == late else lost[0]
        raise CaptureError(
            f"The cameras of {where} have no frames in common: {early!r} ends with {label(slots[early][-1])} "
            f"and {late!r} starts with {label(first)}; check that all belong to one take and share one clock."
        )
    for camera, own in inside.items():
        repeated = next((a for a, b in pairwise(own) if a == b), None)
        if repeated is not None:
            raise CaptureError(
                f"Camera {camera!r} of {where} has two frames for {label(repeated)}; expected one frame per "
                "camera and instant at one common rate. Re-encode it at the rate of the others."
            )
    if before := first - min(own[0] for own in slots.values()):
        text = "%s: camera %r starts with %s; %d earlier frames of other cameras are left out"
        log.warning(text, where, late, label(first), before)
    if after := max(own[-1] for own in slots.values()) - last:
        early = next(camera for camera, own in slots.items() if own[-1] == last)
        text = "%s: camera %r ends with %s; %d later frames of other cameras are left out"
        log.warning(text, where, early, label(last), after)
    common = range(first, last + 1)
    _log_absences(inside, common, where, label, training)
    return common


def _end(slots: Slots, training: Collection[str]) -> int:
    """The last slot that half of the cameras, and two training cameras, reach."""
    ends = sorted((own[-1] for own in slots.values()), reverse=True)
    trained = sorted((own[-1] for name, own in slots.items() if name in training), reverse=True)
    trained = trained or ends  # a rig without training cameras is refused where it is made
    return min(ends[(len(ends) - 1) // 2], trained[min(MIN_CAMERAS, len(trained)) - 1])


def _log_absences(
    slots: Slots, common: range, where: str, label: Callable[[int], str], training: Collection[str]
) -> None:
    """Warnings of absent cameras; ``slots`` are those of the range ``common``."""
    gaps = {camera: sorted({*range(common.start, own[-1] + 1)}.difference(own)) for camera, own in slots.items()}
    gaps = {camera: lacking for camera, lacking in gaps.items() if lacking}
    if len(gaps) > MAX_SINGLE:
        listed = ", ".join(f"{camera!r} {len(lacking)}" for camera, lacking in gaps.items())
        text = "%s: %d cameras lack some of %d frames and are absent there: %s"
        log.warning(text, where, len(gaps), len(common), listed)
        gaps = {}
    for camera, own in slots.items():
        if lacking := gaps.get(camera):
            text = "%s: camera %r lacks %d of %d frames, the first of them %s; it is absent there"
            log.warning(text, where, camera, len(lacking), len(common), label(lacking[0]))
        if after := common[-1] - own[-1]:
            text = "%s: camera %r ends with %s; it is absent from the %d frames after that"
            log.warning(text, where, camera, label(own[-1]), after)
    seeing = Counter(slot for camera, own in slots.items() if camera in training for slot in own)
    sparse = [slot for slot in common if seeing[slot] < MIN_CAMERAS]
    if sparse and len(training) >= MIN_CAMERAS:
        log.warning(
            "%s: %d frames, the first of them %s, have pictures of fewer than %d training cameras, so a reconstruction "
            "stops there; restore them, or choose frames before or after",
            where, len(sparse), label(sparse[0]), MIN_CAMERAS,
        )  # fmt: skip


STANDARD_RATES = tuple(rate * factor for rate in (24, 25, 30, 50, 60, 120) for factor in (1.0, 1000 / 1001))
SAME_RATE = 0.02
"""Rates that differ by less than this share are one: short videos do not distinguish them."""
STEADY = 0.9
"""Length of the mean of the frames' phases as unit vectors, above which a camera keeps one distance to the instants."""
DUPLICATE = 0.5
"""Frames closer than this share of the camera's own period are two of one instant."""


@dataclass(frozen=True)
class Placed:
    """A camera's frames on the common timeline."""

    slots: NDArray[np.int64]  # ``[n]`` int64, ascending: the instants that have a frame
    frames: NDArray[np.int64]  # ``[n]`` int64, the frame of each, counted in the video
    errors: Floats  # ``[n]``, time of the frame minus the instant, in periods
    repeated: tuple[int, ...]  # slots that two frames of one instant compete for, which regular videos do not have


def place(positions: Floats) -> Placed:
    """The frames of a camera at ``positions`` ``[n]``, ascending: their times in periods, instants being integers."""
    mean = np.exp(2j * np.pi * positions).mean()
    shift = float(np.angle(mean) / (2 * np.pi)) if abs(mean) > STEADY else 0.0
    slots = np.rint(positions - shift).astype(np.int64)
    errors = positions - slots
    steps = np.diff(positions)
    close = steps < DUPLICATE * np.median(steps) if len(steps) else np.zeros(0, bool)
    repeated = slots[1:][close & (slots[1:] == slots[:-1])]
    order = np.lexsort((np.abs(errors), slots))
    chosen = order[np.unique(slots[order], return_index=True)[1]]
    return Placed(slots[chosen], chosen.astype(np.int64), errors[chosen], tuple(map(int, repeated)))


def origin_of(positions: Sequence[Floats]) -> float:
    """The instant 0 in periods, such that cameras' first frames lie around instants."""
    origin = min(float(own[0]) for own in positions)
    phases = np.array([float(own[0]) - origin for own in positions])
    # Phases are circular: 0.45 and -0.45 are neighbours.
    middle = np.angle(np.exp(2j * np.pi * phases).mean()) / (2 * np.pi)
    deviations = phases - middle
    return origin + float(middle + np.median(deviations - np.rint(deviations)))


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
    for own in (own for own in seconds if len(own) > 1):
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


def paired(
    seconds: Mapping[str, Floats], *, fps: float, where: str, training: Collection[str], one_each: bool = False
) -> tuple[dict[str, list[int | None]], dict[str, Floats]]:
    """By camera its frame of each instant, or None; and how long after it that one was taken, ``[N]`` s, or NaN.

    The largest distance of a frame to its instant is logged, as a warning above 5 ms.

    Args:
        seconds: by camera the times of its frames on a common clock, ascending.
        fps: instants a second.
        one_each: whether two frames that compete for one instant are refused; else the nearer one is taken.

    Raises:
        CaptureError: see :func:`common_slots`.
    """
    origin = origin_of([own * fps for own in seconds.values()])
    placed = {name: place(own * fps - origin) for name, own in seconds.items()}
    common = common_slots(
        {name: sorted([*own.slots.tolist(), *(own.repeated if one_each else ())]) for name, own in placed.items()},
        where=where,
        label=lambda slot: f"the instant {(origin + slot) / fps:.3f} s",
        training=training,
    )
    frames: dict[str, list[int | None]] = {}
    apart: dict[str, Floats] = {}
    for name, own in placed.items():
        frame_of = dict(zip(own.slots.tolist(), own.frames.tolist()))
        error_of = dict(zip(own.slots.tolist(), own.errors.tolist()))
        frames[name] = [frame_of.get(instant) for instant in common]
        apart[name] = np.array([error_of.get(instant, np.nan) for instant in common]) / fps
    milliseconds = {name: 1e3 * float(np.nanmax(np.abs(own))) for name, own in apart.items()}
    camera, worst = max(milliseconds.items(), key=lambda own: own[1])
    text = "%s: pictures lie up to %.1f ms from their instants (camera %r)"
    if worst > 5:
        log.warning(text + "; what moves fast will not agree between cameras", where, worst, camera)
    else:
        log.info(text, where, worst, camera)
    return frames, apart

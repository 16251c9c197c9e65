# SPDX-License-Identifier: Apache-2.0
"""The time steps that all cameras have."""

import logging
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

from structgstream.errors import CaptureError

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Clock:
    """How a camera's clock relates to the common one: ``common = offset_seconds + rate * stamp_seconds``."""

    offset_seconds: float = 0.0
    rate: float = 1.0


def natural(text: str) -> tuple[tuple[int, int, str], ...]:
    """Sort key that puts ``cam2`` before ``cam10``."""
    parts = [part for part in re.split(r"(\d+)", text) if part]
    return tuple((0, int(part), part) if part.isdecimal() else (1, 0, part) for part in parts)


def common_slots(slots: Mapping[str, Sequence[int]], *, where: str, label: Callable[[int], str]) -> range:
    """The range of slots that every camera has.

    Cameras that start late or end early shorten the range, with a logged warning for each end; a missing or duplicate
    frame inside the range is an error.

    Args:
        slots: camera name to the slots it has, ascending; a slot is one instant of the common timeline.
        where: the capture, for messages.
        label: says which instant a slot is, for messages ("at 0.133 s", "000017").

    Raises:
        CaptureError: no camera pictures, no frames in common, or a missing or duplicate frame.
    """
    for camera, own in slots.items():
        if not own:
            raise CaptureError(f"Camera {camera!r} of {where} has no frames; add them or remove the camera.")
    first = max(own[0] for own in slots.values())
    last = min(own[-1] for own in slots.values())
    if first > last:
        late = next(camera for camera, own in slots.items() if own[0] == first)
        early = next(camera for camera, own in slots.items() if own[-1] == last)
        raise CaptureError(
            f"The cameras of {where} have no frames in common: {early!r} ends with {label(last)} "
            f"and {late!r} starts with {label(first)}; check that all belong to one take and share one clock."
        )
    for camera, own in slots.items():
        inside = [slot for slot in own if first <= slot <= last]
        repeated = next((a for a, b in pairwise(inside) if a == b), None)
        if repeated is not None:
            raise CaptureError(
                f"Camera {camera!r} of {where} has two frames for {label(repeated)}; expected one frame per "
                "camera and instant at one common rate. Re-encode it at the rate of the others."
            )
        if len(inside) != last - first + 1:
            hole = next(slot for slot, has in zip(range(first, last + 1), [*inside, last + 1]) if slot != has)
            raise CaptureError(
                f"Camera {camera!r} of {where} has no frame for {label(hole)}, inside the capture; "
                "restore the frame, or choose a range of frames without it."
            )
    _warn_of_cuts(slots, first, last, where=where, label=label)
    return range(first, last + 1)


def _warn_of_cuts(
    slots: Mapping[str, Sequence[int]], first: int, last: int, *, where: str, label: Callable[[int], str]
) -> None:
    starts = min(own[0] for own in slots.values())
    ends = max(own[-1] for own in slots.values())
    if first > starts:
        late = next(camera for camera, own in slots.items() if own[0] == first)
        log.warning(
            "%s: camera %r starts with %s; %d earlier frames of other cameras are left out",
            where, late, label(first), first - starts,
        )  # fmt: skip
    if last < ends:
        early = next(camera for camera, own in slots.items() if own[-1] == last)
        log.warning(
            "%s: camera %r ends with %s; %d later frames of other cameras are left out",
            where, early, label(last), ends - last,
        )  # fmt: skip

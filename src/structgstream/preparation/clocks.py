# SPDX-License-Identifier: Apache-2.0
"""The clocks of all cameras of a take, and pictures of the same instants by them."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import overload

import numpy as np
from numpy.typing import NDArray

from structgstream.data.lenses import LensCamera
from structgstream.data.timeline import Clock
from structgstream.errors import CaptureError
from structgstream.preparation.footage import Footage
from structgstream.preparation.options import PrepareOptions
from structgstream.preparation.steps import Stored
from structgstream.preparation.synchronization import Method, synchronize

TIMESTAMPS = "timestamps.csv"
SURE_PERIODS = 0.5
"""Standard error of a clock, in frame periods, up to which pictures of one moment can be chosen by it."""


@dataclass(frozen=True)
class Clocks:
    """The clocks of all cameras."""

    clocks: Mapping[str, Clock]  # by camera
    method: str  # how they were found, see ``preparation.synchronization``
    summary: str  # the method and its warnings, for users
    sure: bool = True  # whether pictures of one moment can be chosen by them


def synchronized(
    footage: Footage,
    options: PrepareOptions,
    *,
    cameras: Mapping[str, LensCamera] | None = None,
) -> Clocks:
    """The clocks of the cameras.

    Args:
        footage: what they filmed.
        options: ``synchronize`` is the method.
        cameras: their calibration, where it is known.

    Raises:
        CaptureError: they cannot be synchronised so, or have no moment in common.
        ConfigError: an unknown method.
    """
    single = all(len(footage.stamps(name)) == 1 for name in footage.cameras)
    chosen: Method = "none" if single else options.synchronize
    table = footage.where / TIMESTAMPS
    try:
        found = synchronize(
            footage,
            method=chosen,
            timestamps=table if table.is_file() else None,
            cameras=cameras,
        )
    except CaptureError as error:
        if chosen != "auto":
            raise
        raise CaptureError(f"{error} Cameras that one signal starts need none of this: --synchronize none.") from None
    clocks = {name: estimate.clock for name, estimate in found.clocks.items()}
    shared_seconds(footage, clocks)
    summary = " ".join([f"{found.method}: {found.reason}" + ("." if found.warnings else ""), *found.warnings])
    largest_error = max(estimate.uncertainty_seconds for estimate in found.clocks.values())
    sure = found.method != "motion" or largest_error <= SURE_PERIODS / footage.fps
    return Clocks(clocks, found.method, summary, sure)


def first_clocks(footage: Footage, options: PrepareOptions) -> Clocks:
    """The clocks of cameras whose calibration is to be found without them: by motion they may be unsure, or unknown.

    Motion is inexact without a calibration, and poses come from what stands still. So a failure by motion is no error
    here: motion is compared again once the calibration is known.

    Raises:
        CaptureError: by another method they cannot be synchronised.
        ConfigError: an unknown method.
    """
    try:
        return synchronized(footage, options)
    except CaptureError as error:
        if options.synchronize not in ("auto", "motion") or (footage.where / TIMESTAMPS).is_file():
            raise
        summary = f"motion: not without the calibration. {error}"
        return Clocks({name: Clock() for name in footage.cameras}, "motion", summary, sure=False)


def packed_clocks(found: Clocks) -> Stored:
    """The clocks as plain values."""
    return Stored(
        {
            "clocks": {name: asdict(clock) for name, clock in found.clocks.items()},
            "method": found.method,
            "summary": found.summary,
            "sure": found.sure,
        }
    )


def unpacked_clocks(stored: Stored) -> Clocks:
    """The reverse of :func:`packed_clocks`."""
    values = stored.values
    clocks = {name: Clock(**clock) for name, clock in values["clocks"].items()}
    summary = values["summary"] if "summary" in values else values["told"]  # the former name
    return Clocks(clocks, values["method"], summary, values["sure"])


Picture = NDArray[np.uint8]
STILL_PICTURES = 9


@dataclass(frozen=True)
class Shots(Sequence[Picture]):
    """Pictures of one camera, decoded on access, so that a long take does not fill the memory."""

    footage: Footage
    camera: str
    indices: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.indices)

    @overload
    def __getitem__(self, number: int) -> Picture: ...
    @overload
    def __getitem__(self, number: slice) -> "Shots": ...
    def __getitem__(self, number: int | slice) -> "Picture | Shots":
        if isinstance(number, slice):
            return Shots(self.footage, self.camera, self.indices[number])
        return next(self.footage.pictures(self.camera, [self.indices[number]]))


def shared_seconds(footage: Footage, clocks: Mapping[str, Clock]) -> tuple[float, float]:
    """First and last moment that all cameras filmed, in the time that they share.

    Raises:
        CaptureError: there is none.
    """
    spans = {}
    for name in footage.cameras:
        first, last = clocks.get(name, Clock()).common_seconds(footage.stamps(name)[[0, -1]])
        spans[name] = first, last
    late = max(spans, key=lambda name: spans[name][0])
    early = min(spans, key=lambda name: spans[name][1])
    first, last = spans[late][0], spans[early][1]
    if first > last + 1e-6:
        raise CaptureError(
            f"The cameras of {footage.where} have no moment in common: {footage.path(early).name} of camera {early!r} "
            f"ends {first - last:.3f} s before {footage.path(late).name} of camera {late!r} begins (lengths "
            f"{_length(spans, early)} and {_length(spans, late)}); give longer videos, or leave one camera out with "
            "--without."
        )
    return first, last


def shots_of(footage: Footage, clocks: Mapping[str, Clock], seconds: Sequence[float]) -> dict[str, Shots]:
    """Each camera's pictures nearest to these moments of the shared time."""
    found = {}
    for name in footage.cameras:
        times = clocks.get(name, Clock()).common_seconds(footage.stamps(name))
        indices = [int(np.abs(times - moment).argmin()) for moment in seconds]
        found[name] = Shots(footage, name, tuple(indices))
    return found


def still_pictures(footage: Footage) -> dict[str, list[Picture]]:
    """One picture of each camera without what moves: each value is the median over pictures spread over its take.

    It is of no moment, so it needs no clocks; what stands longer than half of the take remains.
    """
    found = {}
    for name in footage.cameras:
        taken = len(footage.stamps(name))
        count = min(STILL_PICTURES, taken - 1 + taken % 2)  # an odd one, whose median is a value that was filmed
        indices = np.unique(np.linspace(0, taken - 1, count).round().astype(int))
        stacked = np.stack(list(footage.pictures(name, indices.tolist())))
        stacked.partition(count // 2, axis=0)
        found[name] = [stacked[count // 2].copy()]
    return found


def spread_moments(first: float, last: float, count: int) -> list[float]:
    """Moments from the first to the last, both included; fewer when the take has no length."""
    return np.linspace(first, last, count).tolist() if last > first and count > 1 else [first]


def _length(spans: Mapping[str, tuple[float, float]], name: str) -> str:
    return f"{spans[name][1] - spans[name][0]:.3f} s"

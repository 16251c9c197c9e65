# SPDX-License-Identifier: Apache-2.0
"""The clocks of all cameras of a take, as a step of the preparation finds and stores them."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass

from structgstream.data.lenses import LensCamera
from structgstream.data.timeline import Clock
from structgstream.errors import CaptureError
from structgstream.preparation.footage import Footage
from structgstream.preparation.instants import (
    shared_seconds,
)
from structgstream.preparation.options import PrepareOptions
from structgstream.preparation.steps import Stored
from structgstream.preparation.synchronization import Method, synchronize

TIMESTAMPS = "timestamps.csv"
SURE_PERIODS = 0.5
"""Standard error of a clock, in frame periods, up to which pictures of one moment can be chosen by it."""


@dataclass(frozen=True)
class Clocks:
    """The clocks of all cameras.

    Args:
        clocks: by camera.
        method: how they were found, see ``preparation.synchronization``.
        summary: the method and its warnings, for users.
        sure: whether pictures of one moment can be chosen by them.
    """

    clocks: Mapping[str, Clock]
    method: str
    summary: str
    sure: bool = True


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

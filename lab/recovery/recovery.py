# SPDX-License-Identifier: Apache-2.0
"""How far an estimated rig is from the truth: cameras after a similarity, clocks after what all of them share."""

import math
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from structgstream.data.lenses import LensCamera
from structgstream.data.timeline import Clock
from tests.support.calibration_errors import calibration_errors


def camera_errors(
    estimate: Mapping[str, LensCamera],
    truth: Mapping[str, LensCamera],
    *,
    clocks: Mapping[str, Clock],
    true_clocks: Mapping[str, Clock],
    takes: Mapping[str, tuple[float, float]],
) -> dict[str, dict[str, float]]:
    """By camera the errors of ``CameraError``, and ``milliseconds``: the largest error of its common time in its take.

    Args:
        estimate: in any coordinates.
        truth: the true cameras.
        clocks: the estimated clocks.
        true_clocks: the true ones.
        takes: first and last stamp of every camera, seconds.
    """
    late = clock_errors(clocks, true_clocks, takes)
    return {
        name: asdict(error) | {"milliseconds": 1e3 * late.get(name, math.nan)}
        for name, error in calibration_errors(estimate, truth).items()
    }


def clock_errors(
    clocks: Mapping[str, Clock], truth: Mapping[str, Clock], takes: Mapping[str, tuple[float, float]]
) -> dict[str, float]:
    """Largest error, seconds, of a camera's common time over its take.

    The estimate may count common time from another zero, and by the clock of another camera: a shift and a rate that
    all share are taken out by least squares.
    """
    names = [name for name in truth if name in clocks]
    stamps = np.array([[takes[name][0], sum(takes[name]) / 2, takes[name][1]] for name in names])
    true, found = (
        np.array([own[name].common_seconds(row) for name, row in zip(names, stamps, strict=True)])
        for own in (truth, clocks)
    )
    slope, shift = np.polyfit(true.ravel(), found.ravel(), 1)
    errors = np.abs((found - shift) / slope - true)
    return {name: float(row.max()) for name, row in zip(names, errors, strict=True)}


def summary(errors: Mapping[str, Mapping[str, float]]) -> dict[str, dict[str, float | None]]:
    """Median and largest size of each error over the cameras."""
    kinds = next(iter(errors.values()))
    sizes = {kind: np.abs([own[kind] for own in errors.values()]) for kind in kinds}
    return {
        kind: {"median": finite(np.nanmedian(values)), "largest": finite(np.nanmax(values))}
        if np.isfinite(values).any()
        else {"median": None, "largest": None}
        for kind, values in sizes.items()
    }


def plain(errors: Mapping[str, Mapping[str, float]]) -> dict[str, dict[str, Any]]:
    """For JSON: NaN becomes None."""
    return {name: {kind: finite(value) for kind, value in own.items()} for name, own in errors.items()}


def finite(value: float) -> float | None:
    """The number, or None in place of NaN."""
    return None if math.isnan(value) else float(value)

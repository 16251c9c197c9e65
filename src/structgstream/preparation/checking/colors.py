# SPDX-License-Identifier: Apache-2.0
"""Exposure and white balance of cameras relative to each other, from matched pixels, and exposure that changes."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from structgstream.data.images import opencv
from structgstream.frames import MultiViewFrame
from structgstream.geometry import Floats, Indices
from structgstream.pose_check.check import Finding
from structgstream.pose_check.tracks import Evidence

PATCH = 7
DARK, BRIGHT = 12.0, 243.0
ROUNDS = 20
MIN_MATCHES = 15
EXPOSURE_STOPS, BALANCE_STOPS = 0.33, 0.2
ALIKE, ALIKE_SHARE = 1 / 3, 0.5  # of a change, by which pixels differ from it; of pixels that do not differ more


@dataclass(frozen=True)
class Color:
    """A camera's colour against the median camera, as powers of two of linear light."""

    exposure_stops: float  # of green
    red_stops: float  # of red over green
    blue_stops: float  # of blue over green


def compare_colors(evidence: Evidence) -> dict[str, Color]:
    """Cameras whose colours could be compared.

    Least absolute deviations over all matches, as highlights and occlusions make outliers.
    """
    cv2 = opencv()
    smooth = {name: cv2.blur(image, (PATCH, PATCH)) for name, image in evidence.images.items()}
    names = list(evidence.keypoints)
    first, second, ratios = [], [], []
    for pair in evidence.overlapping():
        one, other = (_samples(smooth[name], pixels) for name, pixels in zip(pair, evidence.pixels(pair)))
        valid = ((one > DARK) & (one < BRIGHT) & (other > DARK) & (other < BRIGHT)).all(1)
        if valid.sum() < MIN_MATCHES:
            continue
        first.append(np.full(valid.sum(), names.index(pair[0])))
        second.append(np.full(valid.sum(), names.index(pair[1])))
        ratios.append(np.log2(_linear(one[valid]) / _linear(other[valid])))
    if not ratios:
        return {}
    one, other, values = np.concatenate(first), np.concatenate(second), np.concatenate(ratios)
    seen = sorted({*one.tolist(), *other.tolist()})
    gains = np.stack([_fitted(one, other, values[:, channel], len(names)) for channel in range(3)], 1)
    gains -= np.median(gains[seen], axis=0)
    return {
        names[number]: Color(
            float(gains[number, 1]),
            float(gains[number, 0] - gains[number, 1]),
            float(gains[number, 2] - gains[number, 1]),
        )
        for number in seen
    }


def color_findings(colors: Mapping[str, Color]) -> list[Finding]:
    """Warnings of cameras that were not locked alike."""
    exposure = {name: color.exposure_stops for name, color in colors.items()}
    balance = {name: max(color.red_stops, color.blue_stops, key=abs) for name, color in colors.items()}
    findings = []
    for stops, limit, differs, remedy in (
        (exposure, EXPOSURE_STOPS, "Exposure differs from the other cameras', in stops",
         "lock exposure and gain to the same values on all cameras (reconstruction equalises what is left)"),
        (balance, BALANCE_STOPS, "White balance differs from the other cameras', in stops of red or blue against green",
         "lock it to the same value on all cameras"),
    ):  # fmt: skip
        if off := {name: own for name, own in stops.items() if abs(own) > limit}:
            findings.append(Finding("warning", f"{differs}: {_worst(off)}; {remedy}.", tuple(off)))
    return findings


def exposure_findings(first: MultiViewFrame, last: MultiViewFrame) -> list[Finding]:
    """A warning of cameras whose exposure changed between two frames; light that changes for most is no camera's.

    What moves changes some pixels by different amounts, exposure most pixels by one.
    """
    cv2 = opencv()
    ratios = {}
    for name in (name for name in first.images if name in last.images):
        smooth = (cv2.blur(frame.images[name][..., 1], (PATCH, PATCH)) for frame in (first, last))
        one, other = (green[::PATCH, ::PATCH].astype(np.float64) for green in smooth)
        valid = (np.minimum(one, other) > DARK) & (np.maximum(one, other) < BRIGHT)
        if valid.any():
            ratios[name] = np.log2(_linear(other[valid]) / _linear(one[valid]))
    common = float(np.median([np.median(own) for own in ratios.values()])) if ratios else 0.0
    changed = {}
    for name, own in ratios.items():
        stops = float(np.median(own)) - common
        alike = float(np.mean(np.abs(own - common - stops) < ALIKE * abs(stops)))
        if abs(stops) > EXPOSURE_STOPS and alike > ALIKE_SHARE:
            changed[name] = stops
    if not changed:
        return []
    sentence = (
        f"Exposure changes between frame {first.index} and frame {last.index}, in stops against the other cameras: "
        f"{_worst(changed)}; a stream has one gain for all frames of a camera, so brightness will change with it: lock "
        "exposure and gain before the take."
    )
    return [Finding("warning", sentence, tuple(changed))]


def _worst(stops: Mapping[str, float], limit: int = 6) -> str:
    """The largest differences, for messages."""
    worst = sorted(stops, key=lambda name: -abs(stops[name]))
    rest = f" and {len(worst) - limit} more" if len(worst) > limit else ""
    return ", ".join(f"{name!r} {stops[name]:+.2f}" for name in worst[:limit]) + rest


def _samples(picture: NDArray[np.uint8], pixels: Floats) -> Floats:
    height, width = picture.shape[:2]
    column, row = np.floor(pixels).astype(int).T
    return picture[row.clip(0, height - 1), column.clip(0, width - 1)].astype(np.float64)


def _linear(values: Floats) -> Floats:
    """Linear light of sRGB values in [0, 255] (IEC 61966-2-1)."""
    share = values / 255
    return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4).astype(np.float64)


def _fitted(one: Indices, other: Indices, values: Floats, count: int) -> Floats:
    """Gains ``[count]`` whose differences explain ``values``, by iteratively reweighted least squares."""
    weights = np.ones(len(values))
    gains: Floats = np.zeros(count)
    for _ in range(ROUNDS):
        system, right = 1e-6 * np.eye(count), np.zeros(count)
        for rows, columns, sign in ((one, one, 1), (other, other, 1), (one, other, -1), (other, one, -1)):
            np.add.at(system, (rows, columns), sign * weights)
        np.add.at(right, one, weights * values)
        np.add.at(right, other, -weights * values)
        gains = np.asarray(np.linalg.solve(system, right), np.float64)
        weights = 1 / np.maximum(np.abs(values - gains[one] + gains[other]), 0.02)
    return np.asarray(gains, np.float64)

# SPDX-License-Identifier: Apache-2.0
"""Bjontegaard differences of two rate-distortion curves: bytes at equal quality, or quality at equal rate.

After Bjontegaard (VCEG-M33, 2001), with a curve that is a monotone piecewise cubic over the logarithm of the rate
(Fritsch and Carlson 1980; one polynomial through all points swings between them), integrated in closed form.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from structgstream.errors import ConfigError

Points = Sequence[tuple[float, float]]
"""Rate, in any unit but the same for all, and quality in dB, in any order."""


def bd_rate(ours: Points, theirs: Points) -> float:
    """Bytes more (positive) or less of ``ours`` than of ``theirs`` at equal quality, percent.

    The mean difference of the logarithms of the rates over the qualities that both curves have.

    Raises:
        ConfigError: fewer than two points, a rate that is not positive, a curve on which more rate is not more
            quality, or two curves that share no quality.
    """
    one, other = (_Cubic.through(quality, rate) for rate, quality in map(_checked, (ours, theirs)))
    return 100.0 * math.expm1(_mean_difference(one, other, "quality"))


def bd_psnr(ours: Points, theirs: Points) -> float:
    """Decibels more (positive) or less of ``ours`` than of ``theirs`` at equal rate.

    The mean difference of the qualities over the logarithms of the rates that both curves have.

    Raises:
        ConfigError: as :func:`bd_rate`; two curves that share no rate.
    """
    one, other = (_Cubic.through(rate, quality) for rate, quality in map(_checked, (ours, theirs)))
    return _mean_difference(one, other, "rate")


def rate_at(points: Points, quality: float) -> float | None:
    """The rate of a curve at ``quality`` (dB); None outside of it.

    Raises:
        ConfigError: as :func:`bd_rate`.
    """
    rate, qualities = _checked(points)
    found = _Cubic.through(qualities, rate).at(quality)
    return None if found is None else math.exp(found)


def psnr_at(points: Points, rate: float) -> float | None:
    """The quality (dB) of a curve at a rate; None outside of it.

    Raises:
        ConfigError: as :func:`bd_rate`.
    """
    rates, quality = _checked(points)
    return _Cubic.through(rates, quality).at(math.log(rate)) if rate > 0 else None


Numbers = NDArray[np.float64]


def _checked(points: Points) -> tuple[Numbers, Numbers]:
    """Logarithms of the rates, ascending, and the qualities."""
    if len(points) < 2:
        raise ConfigError(f"A rate-distortion curve needs two points or more, got {len(points)}.")
    if not all(rate > 0 and math.isfinite(rate) and math.isfinite(quality) for rate, quality in points):
        raise ConfigError("Rates of a rate-distortion curve must be positive and its qualities finite.")
    table = np.array(sorted(points), np.float64)
    if (np.diff(table, axis=0) <= 0).any():
        raise ConfigError(
            "On a rate-distortion curve more rate must be more quality; measure again, or leave out points."
        )
    return np.log(table[:, 0]), table[:, 1]


@dataclass(frozen=True)
class _Cubic:
    """A piecewise cubic: on the piece from ``knots[i]`` on, powers of the distance to it, ``powers`` ``[4, n - 1]``."""

    knots: Numbers
    powers: Numbers

    @classmethod
    def through(cls, x: Numbers, y: Numbers) -> "_Cubic":
        """Through ascending points, ascending between them."""
        width = np.diff(x)
        rise = np.diff(y) / width
        slope = _slopes(width, rise)
        squares = (3 * rise - 2 * slope[:-1] - slope[1:]) / width
        cubes = (slope[:-1] + slope[1:] - 2 * rise) / width**2
        return cls(x, np.stack([y[:-1], slope[:-1], squares, cubes]))

    def at(self, x: float) -> float | None:
        """The value at ``x``; None outside."""
        if not self.knots[0] <= x <= self.knots[-1]:
            return None
        piece = min(int(np.searchsorted(self.knots, x, side="right")) - 1, len(self.knots) - 2)
        return float((x - self.knots[piece]) ** np.arange(4) @ self.powers[:, piece])

    def integral(self, start: float, end: float) -> float:
        """From ``start`` to ``end``, both inside."""
        order = np.arange(1, 5)[:, None]
        low, high = (np.clip(x - self.knots[:-1], 0.0, np.diff(self.knots)) for x in (start, end))
        return float((self.powers / order * (high**order - low**order)).sum())


def _slopes(width: Numbers, rise: Numbers) -> Numbers:
    """At each point the weighted harmonic mean of the slopes beside it; at the ends a parabola's, not falling."""
    if len(width) == 1:
        return np.repeat(rise, 2)
    near, far = 2 * width[1:] + width[:-1], width[1:] + 2 * width[:-1]
    inner = (near + far) / (near / rise[:-1] + far / rise[1:])
    ends = [
        max(0.0, ((2 * width[i] + width[j]) * rise[i] - width[i] * rise[j]) / (width[i] + width[j]))
        for i, j in ((0, 1), (-1, -2))
    ]
    return np.concatenate([ends[:1], inner, ends[1:]])


def _mean_difference(one: _Cubic, other: _Cubic, shared: str) -> float:
    start, end = max(one.knots[0], other.knots[0]), min(one.knots[-1], other.knots[-1])
    if not start < end:
        raise ConfigError(f"Two rate-distortion curves share no {shared}, so they cannot be compared over it.")
    return (one.integral(start, end) - other.integral(start, end)) / float(end - start)

# SPDX-License-Identifier: Apache-2.0
"""Lag and drift of two signals over a whole take.

A take is cut into blocks of time that all pairs of cameras share. In each block the cross-correlation near the expected
lag is compared with what the signals' own autocorrelation, moved by a lag, would give; the lag changes in proportion to
time, and all blocks are fitted together by least squares. So a block in which little happens has little weight, and a
block whose best lag alone would be off by half a frame (sharp events between two frames) does not decide.

What the fit becomes without each of the blocks gives its error (jackknife), even one that all pairs of a camera share.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from structgstream.data.arrays import Floats
from structgstream.preparation.synchronization.correlation import Signal, parabola_top

MAX_RATE = 2e-3  # between two clocks; 29.97 and 30 frames a second taken for each other are 1e-3
RATE_STEP, LAG_STEP = 1e-4, 0.05  # of the search; lags in samples
NEAR_SAMPLES = 2  # on both sides of the expected lag
MIN_ENERGY = 0.05  # of a block, of the mean one: below it is no more reliable


@dataclass(frozen=True)
class Line:
    """A lag that changes in proportion to time.

    Args:
        middle: second by the first signal's time at which the lag is ``lag_seconds``.
        lag_seconds: time in the second signal minus time in the first.
        rate: change of the lag a second; None where the signals do not determine it.
        spread_seconds: standard deviation of the blocks' times.
        lag_changes: ``[K]`` seconds, change of the lag without each of the blocks.
        rate_changes: ``[K]``, that of the rate.
    """

    middle: float
    lag_seconds: float
    rate: float | None
    spread_seconds: float
    lag_changes: Floats
    rate_changes: Floats

    @property
    def lag_sigma(self) -> float:
        """Standard error of the lag by the jackknife, seconds."""
        return _jackknife(self.lag_changes)

    @property
    def rate_sigma(self) -> float:
        """Standard error of the rate by the jackknife."""
        return _jackknife(self.rate_changes)


@dataclass(frozen=True)
class _Blocks:
    """Sums over the blocks that have something: ``cross`` and ``own`` ``[K, 2R + 1]`` at lags of whole samples around
    ``lag_seconds``, own being the mean autocorrelation; ``times`` and ``numbers`` ``[K]`` are those of the blocks."""

    cross: Floats
    own: Floats
    times: Floats
    numbers: NDArray[np.intp]
    lag_seconds: float


def fitted_line(
    first: Signal, second: Signal, *, expected_seconds: float, edges: Floats, rates: bool = True
) -> Line | None:
    """The line that agrees best with two signals; None where they overlap or move too little.

    Args:
        first: a signal.
        second: another, of the same step and channels.
        expected_seconds: time in the second signal minus time in the first, known to two samples.
        edges: ``[K + 1]`` bounds of the blocks by the first signal's time.
        rates: whether the lag may change.
    """
    half = (edges[-1] - edges[0]) / 2
    reach = NEAR_SAMPLES + (round(MAX_RATE * half / first.step) if rates else 0)
    blocks = _blocks(first, second, expected_seconds, edges, reach + 2)
    if blocks is None:
        return None
    count, step = len(edges) - 1, first.step
    middle = float(blocks.times.mean())
    tried = np.arange(-MAX_RATE, MAX_RATE + RATE_STEP / 2, RATE_STEP) if rates else np.zeros(1)
    lags = np.arange(-NEAR_SAMPLES, NEAR_SAMPLES + LAG_STEP / 2, LAG_STEP)
    gains = _gains(blocks, (blocks.times - middle) / step, tried, lags, reach)
    best = _best(gains, np.arange(len(blocks.times)), tried, lags)
    without = np.array(
        [_best(gains, np.delete(np.arange(len(blocks.times)), k), tried, lags) for k in range(len(blocks.times))]
    )
    has_rate = len(tried) > 1 and bool(np.abs([best[1], *without[:, 1]]).max() < MAX_RATE - RATE_STEP)
    if not has_rate and len(tried) > 1:
        return fitted_line(first, second, expected_seconds=expected_seconds, edges=edges, rates=False)
    changes = np.zeros((count, 2))
    changes[blocks.numbers] = without - best
    return Line(
        middle,
        blocks.lag_seconds + best[0] * step,
        best[1] if has_rate else None,
        float(blocks.times.std()),
        changes[:, 0] * step,
        changes[:, 1],
    )


def _blocks(first: Signal, second: Signal, expected: float, edges: Floats, reach: int) -> _Blocks | None:
    shift = round((first.start + expected - second.start) / first.step)
    low = max(reach, reach - shift)
    high = min(len(first.values) - reach, len(second.values) - reach - shift)
    if high - low < 2 * reach:
        return None
    x = first.values - first.values[low:high].mean(0)
    y = second.values - second.values[low + shift : high + shift].mean(0)
    times = first.start + first.step * np.arange(low, high)
    inside = (times >= edges[0]) & (times <= edges[-1])
    block = np.clip(np.searchsorted(edges, times, side="right") - 1, 0, len(edges) - 2)
    counts = np.bincount(block[inside], minlength=len(edges) - 1)

    def summed(one: Floats, other: Floats, start: int, other_start: int, lag: int) -> NDArray[Any]:
        products = np.einsum(
            "tb,tb->t", one[start : start + high - low], other[other_start + lag : other_start + lag + high - low]
        )
        return np.bincount(block[inside], products[inside], minlength=len(edges) - 1)

    lags = range(-reach, reach + 1)
    # Each lag is half of x moved and half of y moved, so that no end of the overlap counts more than the other.
    cross = np.stack([summed(x, y, low, low + shift, lag) + summed(y, x, low + shift, low, -lag) for lag in lags], 1)
    own_x = np.stack([summed(x, x, low, low, lag) for lag in lags], 1)
    own_y = np.stack([summed(y, y, low + shift, low + shift, lag) for lag in lags], 1)
    energy_x, energy_y = own_x[:, reach].sum(), own_y[:, reach].sum()
    if not energy_x > 0 or not energy_y > 0:
        return None
    own = own_x * np.sqrt(energy_y / energy_x) + own_y * np.sqrt(energy_x / energy_y)
    own = (own + own[:, ::-1]) / 4
    used = np.flatnonzero((counts > 0) & (own[:, reach] > 1e-3 * own[:, reach].max()))
    if len(used) < 3:
        return None
    middles = np.bincount(block[inside], times[inside], minlength=len(edges) - 1)[used] / counts[used]
    return _Blocks(cross[used] / 2, own[used], middles, used, second.start + shift * second.step - first.start)


def _gains(blocks: _Blocks, times: Floats, rates: Floats, lags: Floats, reach: int) -> Floats:
    """Sums ``[5, K, Q, L]`` over lags of whole samples up to ``reach``, for each block, rate and lag: of what is seen
    times each of two shapes, and of the products of the shapes (11, 12, 22).

    The first shape is the autocorrelation with a smooth top at lag 0, the second one what its peak there is above that
    top: sharp events make it, and noise, which the other signal does not have. Both are interpolated linearly, as the
    correlation of events is which fall on one of two frames. Blocks have the weight that makes their noise equal.
    """
    middle_lag = blocks.own.shape[1] // 2
    energy = blocks.own[:, middle_lag]
    weights = 1 / np.maximum(energy, MIN_ENERGY * energy.mean())
    seen = np.arange(-reach, reach + 1)
    first, second = blocks.own[:, middle_lag + 1], blocks.own[:, middle_lag + 2]
    smooth = blocks.own.copy()
    smooth[:, middle_lag] = np.clip((4 * first - second) / 3, np.minimum(first, energy), energy)  # a parabola's top
    sums = np.empty((5, len(times), len(rates), len(lags)))
    for k, time in enumerate(times):
        place = np.clip(seen[:, None, None] - lags - rates[:, None] * time + middle_lag, 0, 2 * middle_lag - 1e-9)
        left = place.astype(int)
        share = place - left
        wide = smooth[k][left] * (1 - share) + smooth[k][left + 1] * share
        peak = (energy[k] - smooth[k, middle_lag]) * np.maximum(1 - np.abs(place - middle_lag), 0)
        cross = blocks.cross[k][seen + middle_lag]
        products = np.tensordot(cross, wide, 1), np.tensordot(cross, peak, 1)
        sums[:, k] = weights[k] * np.stack([*products, (wide**2).sum(0), (wide * peak).sum(0), (peak**2).sum(0)])
    return sums


def _best(gains: Floats, blocks: NDArray[np.intp], rates: Floats, lags: Floats) -> tuple[float, float]:
    """Lag in samples and rate of the least squares' minimum over all gains, refined by parabolas."""
    explained = _explained(gains[:, blocks].sum(1))
    q, lag = np.unravel_index(int(explained.argmax()), explained.shape)
    return _top(explained[q], int(lag), lags), _top(explained[:, lag], int(q), rates)


def _explained(sums: Floats) -> Floats:
    """By how much the shapes with their best gains reduce the sum of squares: the second gain is at least 0, and at
    most the first, as signals without noise have it."""
    seen, other, own, mixed, peak = sums
    tiny = 1e-12 * float(own.max()) + 1e-300
    without = np.maximum(seen, 0) ** 2 / (own + tiny)
    whole = np.maximum(seen + other, 0) ** 2 / (own + 2 * mixed + peak + tiny)
    determinant = own * peak - mixed**2
    first, second = peak * seen - mixed * other, own * other - mixed * seen
    inside = (second > 0) & (second < first) & (determinant > 1e-6 * own * peak)
    both = (first * seen + second * other) / np.where(inside, determinant, 1.0)
    return np.where(inside, both, np.maximum(without, whole))


def _top(values: Floats, best: int, places: Floats) -> float:
    """Place of the top of the parabola around the best value; the best place at an end."""
    if not 0 < best < len(values) - 1:
        return float(places[best])
    shift = float(parabola_top(*values[best - 1 : best + 2], flat=0.0))
    return float(places[best] + shift * (places[1] - places[0]))


def _jackknife(changes: Floats) -> float:
    used = changes[changes != 0]
    return float(np.sqrt((len(used) - 1) / len(used) * np.sum((used - used.mean()) ** 2))) if len(used) > 1 else 0.0

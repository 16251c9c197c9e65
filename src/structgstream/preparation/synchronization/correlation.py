# SPDX-License-Identifier: Apache-2.0
"""Lag and drift of two signals of several channels.

Normalised cross-correlation over all lags: means and energies are those of the overlap at each lag, so neither a
constant level nor a long silence moves the peak.

A line of lags over a whole take: the take is cut into blocks of time that all pairs of cameras share. In each block the
cross-correlation near the expected lag is compared with what the signals' own autocorrelation, moved by a lag, would
give; the lag changes in proportion to time, and all blocks are fitted together by least squares. So a block in which
little happens has little weight. What the fit becomes without each of the blocks gives its error (jackknife), even one
that all pairs of a camera share."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from structgstream.geometry import Floats, Indices

GROUPS = 8  # of channels, left out one by one to see how the peak moves


@dataclass(frozen=True)
class Signal:
    """Values ``[T, B]`` of B channels at ``start + k * step`` seconds."""

    values: Floats
    start: float
    step: float

    @property
    def end(self) -> float:
        return self.start + (len(self.values) - 1) * self.step

    def cut(self, start: float, end: float) -> "Signal":
        """The part between two seconds."""
        first = max(int(np.ceil((start - self.start) / self.step - 1e-9)), 0)
        last = min(int(np.floor((end - self.start) / self.step + 1e-9)), len(self.values) - 1)
        return Signal(self.values[first : last + 1], self.start + first * self.step, self.step)


@dataclass(frozen=True)
class Lag:
    """Where two signals agree best."""

    seconds: float  # time in the second signal minus time in the first
    sigma_seconds: float
    """Standard error, from the peaks without each group of channels; half a step with fewer than three channels."""
    peak: float  # correlation there, at most 1
    judged: float  # correlation times the square root of the overlap's share of the longest one
    rival: float  # largest such value outside the peak
    deviation: float  # standard deviation of such values over all lags, as chance makes them
    middle: float  # the middle of the overlap, by the first signal's time


def resampled(values: Floats, stamps: Floats, *, step: float) -> Signal:
    """A signal from values ``[T, B]`` at ascending ``stamps`` ``[T]``, linearly interpolated at multiples of
    ``step``."""
    count = max(int(np.floor((stamps[-1] - stamps[0]) / step + 1e-6)) + 1, 1)
    times = stamps[0] + np.arange(count) * step
    if len(times) == len(stamps) and np.abs(times - stamps).max() < 0.02 * step:
        return Signal(values, float(stamps[0]), step)
    columns = [np.interp(times, stamps, column) for column in values.T]
    return Signal(np.stack(columns, axis=1), float(stamps[0]), step)


def best_lag(
    first: Signal, second: Signal, *, within: tuple[float, float] | None = None, min_overlap: int = 8
) -> Lag | None:
    """The lag of the largest correlation of signals of one step and as many channels, with ``min_overlap`` samples or
    more in common; None if there is no overlap, no change in it, or no peak ``within`` the smallest and largest lag in
    seconds."""
    score, numerators, energy, counts, lags = _scores(first, second, min_overlap)
    seconds = second.start - first.start + lags * first.step
    if within is not None:
        score = np.where((seconds >= within[0]) & (seconds <= within[1]), score, -np.inf)
    if not np.isfinite(score).any():
        return None
    # A short overlap agrees by chance; correlations are judged by their significance.
    judged = score * np.sqrt(counts / counts.max())
    best = int(judged.argmax())
    # A best lag next to those that are not considered is no peak.
    if score[best] <= 0 or not 0 < best < len(score) - 1 or not np.isfinite(score[best - 1 : best + 2]).all():
        return None
    shift = float(np.clip(parabola_top(*score[best - 1 : best + 2], flat=0.0), -0.5, 0.5))
    sigma = _sigma(numerators, energy, best, first.step)
    rival = _rival(judged, best)
    overlap_start = max(first.start, second.start - seconds[best])
    overlap_end = min(first.end, second.end - seconds[best])
    return Lag(
        float(seconds[best] + shift * first.step),
        sigma,
        float(score[best]),
        float(judged[best]),
        rival,
        float(judged[np.isfinite(judged)].std()),
        (overlap_start + overlap_end) / 2,
    )


def lag_changes(first: Signal, second: Signal, lag_seconds: float, edges: Floats) -> Floats:
    """By how much the lag of the largest correlation, at ``lag_seconds`` of :func:`best_lag`, grows without each block
    of the take, ``[K]`` seconds.

    Blocks that all pairs of cameras share show errors that all pairs of a camera share: of things that move for less
    than a frame one camera's frames see other parts than another's. Leaving out channels does not show these.

    ``edges`` are the ``[K + 1]`` bounds of the blocks by the first signal's time.
    """
    best = round((lag_seconds - second.start + first.start) / first.step)
    blocks = len(edges) - 1
    sums = np.zeros((3, 3, blocks))  # lag; product and energies; block
    for row, lag in enumerate((best - 1, best, best + 1)):
        low, high = max(0, -lag), min(len(first.values), len(second.values) - lag)
        x = first.values[low:high] - first.values[low:high].mean(0)
        y = second.values[low + lag : high + lag] - second.values[low + lag : high + lag].mean(0)
        times = first.start + first.step * np.arange(low, high)
        block = np.clip(np.searchsorted(edges, times, side="right") - 1, 0, blocks - 1)
        for column, one, other in ((0, x, y), (1, x, x), (2, y, y)):
            sums[row, column] = np.bincount(block, np.einsum("tb,tb->t", one, other), minlength=blocks)
    whole = sums.sum(2, keepdims=True)
    without = np.concatenate([whole, whole - sums], axis=2)  # all blocks, and all but each
    energy = np.sqrt(np.maximum(without[:, 1] * without[:, 2], 0.0))
    score = without[:, 0] / np.where(energy > 0, energy, np.inf)
    top = np.clip(parabola_top(*score, flat=1.0), -1, 1)  # without a peak it may be anywhere
    return (top[1:] - top[0]) * first.step


def chance_deviation(first: Signal, second: Signal) -> float:
    """Standard deviation that the correlation of two independent signals with these autocorrelations would have
    (Bartlett's formula); of the first channels."""
    from scipy.signal import correlate

    count = min(len(first.values), len(second.values))
    curves = []
    for signal in (first, second):
        values = signal.values[:, 0] - signal.values[:, 0].mean()
        whole = correlate(values, values, method="fft")[len(values) - 1 :][:count]
        curves.append(whole / max(float(whole[0]), 1e-300))
    products = curves[0] * curves[1] * (1 - np.arange(count) / count)
    return float(np.sqrt(max(2 * products.sum() - 1, 1.0) / count))


def _scores(first: Signal, second: Signal, min_overlap: int) -> tuple[Floats, Floats, Floats, Indices, Indices]:
    """For each lag: correlation, its numerator by channel, energy, number of samples; and the lags."""
    from scipy.fft import irfft, next_fast_len, rfft

    x, y = first.values - first.values.mean(0), second.values - second.values.mean(0)
    n, m = len(x), len(y)
    size = int(next_fast_len(n + m, real=True) or 0)
    spectra = [np.asarray(rfft(values, size, axis=0)) for values in (x, y)]
    products = np.asarray(irfft(np.conj(spectra[0]) * spectra[1], size, axis=0))
    lags = np.arange(-(n - 1), m)
    products = products[lags % size]
    starts, ends = np.maximum(0, -lags), np.minimum(n, m - lags)  # of the overlap, in the first signal
    counts = ends - starts
    sums_x, squares_x = _sums(x, starts, ends)
    sums_y, squares_y = _sums(y, starts + lags, ends + lags)
    numerators = products - sums_x * sums_y / counts[:, None]
    energy_x = (squares_x - sums_x**2 / counts[:, None]).sum(1)
    energy_y = (squares_y - sums_y**2 / counts[:, None]).sum(1)
    energy = np.sqrt(np.maximum(energy_x * energy_y, 0.0))
    # Where hardly anything happens in an overlap, noise would agree with noise.
    enough = (
        (counts >= min_overlap) & (energy_x > 0.02 * energy_x.max()) & (energy_y > 0.02 * energy_y.max()) & (energy > 0)
    )
    score = np.where(enough, numerators.sum(1) / np.where(energy > 0, energy, 1.0), -np.inf)
    return score, numerators, energy, counts, lags


def _sums(values: Floats, starts: Indices, ends: Indices) -> tuple[Floats, Floats]:
    """Sums of values and of squares over ranges of rows."""
    zero = np.zeros((1, values.shape[1]))
    totals = np.concatenate([zero, np.cumsum(values, axis=0)])
    squares = np.concatenate([zero, np.cumsum(values**2, axis=0)])
    return totals[ends] - totals[starts], squares[ends] - squares[starts]


def parabola_top(left: ArrayLike, middle: ArrayLike, right: ArrayLike, *, flat: float) -> Floats:
    """Where the parabola through three equidistant values has its top, in steps from the middle one; ``flat`` where it
    has none."""
    left, right = np.asarray(left), np.asarray(right)
    curvature = np.asarray(left - 2 * np.asarray(middle) + right)
    peaked = curvature < 0
    return np.where(peaked, (left - right) / (2 * np.where(peaked, curvature, -1.0)), flat)


def _rival(score: Floats, best: int) -> float:
    """Largest score outside the lobe of the best one."""
    left = right = best
    while left > 0 and score[left - 1] < score[left]:
        left -= 1
    while right < len(score) - 1 and score[right + 1] < score[right]:
        right += 1
    outside = np.concatenate([score[: max(left, 0)], score[right + 1 :]])
    finite = outside[np.isfinite(outside)]
    return float(finite.max()) if len(finite) else -1.0


def _sigma(numerators: Floats, energy: Floats, best: int, step: float) -> float:
    """Standard error of the peak by the jackknife over groups of channels."""
    groups = min(GROUPS, numerators.shape[1])
    if groups < 3:
        return step / 2
    near = slice(best - 1, best + 2)
    total = numerators[near].sum(1)
    bounds = np.linspace(0, numerators.shape[1], groups + 1).astype(int)
    peaks = []
    for low, high in pairwise(bounds):
        rest = (total - numerators[near, low:high].sum(1)) / energy[near]
        peaks.append(np.clip(parabola_top(*rest, flat=1.0), -1, 1))
    spread = np.sqrt((groups - 1) * np.var(peaks))
    return float(max(spread, 0.01)) * step


MAX_RATE = 2e-3  # between two clocks; 29.97 and 30 frames a second taken for each other are 1e-3
RATE_STEP, LAG_STEP = 1e-4, 0.05  # of the search; lags in samples
NEAR_SAMPLES = 2  # on both sides of the expected lag
MIN_ENERGY = 0.05  # of a block, of the mean one: below it is no more reliable


@dataclass(frozen=True)
class Line:
    """A lag that changes in proportion to time."""

    middle: float  # second by the first signal's time at which the lag is ``lag_seconds``
    lag_seconds: float  # time in the second signal minus time in the first
    rate: float | None  # change of the lag a second; None where the signals do not determine it
    spread_seconds: float  # standard deviation of the blocks' times
    lag_changes: Floats  # ``[K]`` seconds, change of the lag without each of the blocks
    rate_changes: Floats  # ``[K]``, that of the rate

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
    numbers: Indices
    lag_seconds: float


def fitted_line(
    first: Signal, second: Signal, *, expected_seconds: float, edges: Floats, rates: bool = True
) -> Line | None:
    """The line that agrees best with two signals; None where they overlap or move too little.

    Args:
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
    every = np.arange(len(blocks.times))
    best = _best(gains, every, tried, lags)
    without = np.array([_best(gains, np.delete(every, k), tried, lags) for k in every])
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


def _best(gains: Floats, blocks: Indices, rates: Floats, lags: Floats) -> tuple[float, float]:
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

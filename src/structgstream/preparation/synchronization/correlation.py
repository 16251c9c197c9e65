# SPDX-License-Identifier: Apache-2.0
"""Normalised cross-correlation of two signals of several channels over all lags.

Means and energies are those of the overlap at each lag, so neither a constant level nor a long silence moves the peak.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from structgstream.data.arrays import Floats
from structgstream.errors import MissingExtraError

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
    """Where two signals agree best.

    Args:
        seconds: time in the second signal minus time in the first.
        sigma_seconds: standard error, from the peaks without each group of channels; half a step with a single channel.
        peak: correlation there, at most 1.
        judged: correlation times the square root of the overlap's share of the longest one.
        rival: largest such value outside the peak.
        deviation: standard deviation of such values over all lags, as chance makes them.
        middle: the middle of the overlap, by the first signal's time.
    """

    seconds: float
    sigma_seconds: float
    peak: float
    judged: float
    rival: float
    deviation: float
    middle: float


def require_scipy() -> None:
    """
    Raises:
        MissingExtraError: scipy is not installed.
    """
    try:
        import scipy  # noqa: F401
    except ImportError:
        raise MissingExtraError("scipy", "capture") from None


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
    """The lag of the largest correlation; None if there is no overlap, no change in
    it, or no peak.

    Args:
        first: a signal.
        second: another, of the same step and channels.
        within: smallest and largest lag in seconds; None for all.
        min_overlap: smallest number of samples in common.
    """
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
    """By how much the lag of the largest correlation grows without each block of the take, ``[K]`` seconds.

    Blocks that all pairs of cameras share show errors that all pairs of a camera share: of things that move for less
    than a frame one camera's frames see other parts than another's. Leaving out channels does not show these.

    Args:
        first: a signal.
        second: another, of the same step and channels.
        lag_seconds: what :func:`best_lag` found.
        edges: ``[K + 1]`` bounds of the blocks by the first signal's time.
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


def _scores(
    first: Signal, second: Signal, min_overlap: int
) -> tuple[Floats, Floats, Floats, NDArray[np.intp], NDArray[np.intp]]:
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


def _sums(values: Floats, starts: NDArray[np.intp], ends: NDArray[np.intp]) -> tuple[Floats, Floats]:
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

# SPDX-License-Identifier: Apache-2.0
"""Instants that pairs of cameras share, from what moves in their pictures.

Without geometry the activity of whole pictures is compared, which is good to a frame where enough happens. With
epipolar geometry signals of corresponding lines are compared (``motion_signals.py``), which is good to a tenth of a
frame for one pair. A first round considers all lags; the second one looks near those that most pairs agree on, and, in
takes that are long enough, for drift.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from structgstream.data.matching import connected_groups
from structgstream.data.timeline import period_seconds
from structgstream.errors import CaptureError
from structgstream.preparation.synchronization.correlation import (
    Line,
    Signal,
    best_lag,
    chance_deviation,
    fitted_line,
    lag_changes,
    resampled,
)
from structgstream.preparation.synchronization.motion_signals import Changes, Geometry, line_signals
from structgstream.preparation.synchronization.solving import Solution, TimeCorrespondence, camera_pairs, solve_clocks

MIN_SAMPLES = 6  # that two views must have in common, in frames
MIN_OVERLAP = 0.2  # of the shorter take
MIN_PEAK = 0.25  # correlation of views that see the same
# Of activities, and of lines whose geometry is an estimate from few features, a peak must stand out more.
CHANCE_DEVIATIONS = 4.5
ESTIMATED_PEAK, CONTROL_RATIO = 0.5, 1.2
RIVAL_RATIO = 0.9  # another lag that is nearly as good makes a pair ambiguous
MIN_SUPPORT = 0.3  # share of a camera's pairs that agree with its clock
MIN_DRIFT_SECONDS = 6.0  # of the take, from which on drift is looked for
BLOCK_SECONDS, MAX_BLOCKS = 1.0, 12
NEAR_BLOCKS, NEAR_SAMPLES = (
    6,
    8,
)  # largest number of blocks of shorter takes, left out one by one, and smallest number of samples of each
NEAR_PERIODS = 2.0
MIN_LINE_SIGMA = 0.02  # periods: few blocks may agree by chance
# Standard deviation of a camera's own error, that all its pairs share because views see different parts of what moves;
# in periods, with a known geometry, with one from static features, and by activities.
BIAS_PERIODS, ESTIMATED_BIAS_PERIODS, ACTIVITY_BIAS_PERIODS = 0.06, 0.3, 1.0
OPTIMISM = 1.5  # true errors of pairs over their jackknife errors, measured on three captures with known clocks


@dataclass(frozen=True)
class PairSignals:
    """Signals of two cameras that rise and fall together."""

    first: str
    second: str
    signals: tuple[Signal, Signal]
    epipolar: bool  # whether they belong to corresponding epipolar lines, else to whole pictures
    estimated: bool = False  # whether the epipolar geometry is an estimate that may be wrong


def pair_signals(changes: Mapping[str, Changes], geometry: Geometry | None) -> list[PairSignals]:
    """Signals of all pairs of cameras in which something moves: of epipolar lines where the geometry is known."""
    moving = [name for name, change in changes.items() if change.moving]
    found = []
    for first, second in combinations(moving, 2):
        one, other = changes[first], changes[second]
        step = min(period_seconds(one.times), period_seconds(other.times))
        pair = geometry.pair(first, second) if geometry else None
        values = line_signals(one, other, pair) if pair else None
        both = values or (one.activity, other.activity)
        signals = resampled(both[0], one.times, step=step), resampled(both[1], other.times, step=step)
        epipolar = values is not None
        estimated = epipolar and pair is not None and pair.estimated
        found.append(PairSignals(first, second, signals, epipolar, estimated))
    return found


def motion_correspondences(pairs: Sequence[PairSignals], *, near: Solution | None = None) -> list[TimeCorrespondence]:
    """Time correspondences from signals of pairs.

    Args:
        pairs: what :func:`pair_signals` gives.
        near: clocks near which lags and drift are looked for; None looks at all lags.
    """
    if near is None:
        return [match for pair in pairs for match in _whole(pair)]
    bounds = [
        (near.offsets[pair.first] + pair.signals[0].start, near.offsets[pair.first] + pair.signals[0].end)
        for pair in pairs
    ]
    low, high = min(low for low, _ in bounds), max(high for _, high in bounds)
    if high - low < MIN_DRIFT_SECONDS:
        count = min(int((high - low) / max(pair.signals[0].step for pair in pairs)) // NEAR_SAMPLES, NEAR_BLOCKS)
        # Of a second, what is left without a block has no peak of its own.
        edges = np.linspace(low, high, count + 1) if count > 2 else None
        return [match for pair in pairs for match in _near(pair, near, edges)]
    edges = np.linspace(low, high, min(int((high - low) / BLOCK_SECONDS), MAX_BLOCKS) + 1)
    return [match for pair in pairs for match in _along(pair, near, edges)]


def solve_by_motion(
    takes: Mapping[str, tuple[float, float]], pairs: Sequence[PairSignals], *, slack_seconds: float, drift: bool
) -> Solution:
    """Clocks by motion.

    Args:
        takes: camera to the first and last second of its take.
        pairs: what :func:`pair_signals` gives.
        slack_seconds: half a frame period.
        drift: whether rates other than 1 are considered.

    Raises:
        CaptureError: cameras that share no motion with the others.
    """
    group, coarse, good = agreeing_cameras(takes, pairs, slack_seconds=slack_seconds)
    if coarse is None or len(group) < len(takes):
        seconds = min(end - start for start, end in takes.values())
        raise CaptureError(_unconnected([name for name in takes if name not in group], group, seconds))
    matches = motion_correspondences(good, near=coarse)
    if len(connected_groups(takes, camera_pairs(matches))) > 1:  # too little is left near the clocks of the first round
        matches = motion_correspondences(good)
    solution = solve_clocks(takes, matches, drift=drift, slack_seconds=slack_seconds)
    errors = {
        name: float(np.hypot(solution.sigmas[name], _bias(name, good) * 2 * slack_seconds)) for name in solution.sigmas
    }
    return replace(solution, sigmas=errors)


def agreeing_cameras(
    takes: Mapping[str, tuple[float, float]], pairs: Sequence[PairSignals], *, slack_seconds: float
) -> tuple[tuple[str, ...], Solution | None, list[PairSignals]]:
    """The largest group of cameras whose motion agrees, its clocks by whole takes, and the pairs that agree with
    these."""
    matches = motion_correspondences(pairs)
    group = connected_groups(takes, camera_pairs(matches))[0]
    solution = None
    good: list[PairSignals] = []
    while len(group) > 1:
        inside = [match for match in matches if match.first in group and match.second in group]
        own = {name: takes[name] for name in group}
        solution = solve_clocks(own, inside, drift=False, slack_seconds=slack_seconds)
        agreeing = [match for match, agrees in zip(inside, solution.agreeing, strict=True) if agrees]
        supported = [match for match in agreeing if _supported(match, inside, agreeing)]
        names = {(match.first, match.second) for match in supported}
        good = [pair for pair in pairs if (pair.first, pair.second) in names]
        smaller = connected_groups(group, camera_pairs(supported))[0]
        if len(smaller) == len(group):
            return group, solution, good
        group = smaller
    return group, None, []


def _bias(name: str, pairs: Sequence[PairSignals]) -> float:
    """A camera's own error, in periods, by the best of its pairs."""
    own = [pair for pair in pairs if name in (pair.first, pair.second)]
    if any(pair.epipolar and not pair.estimated for pair in own):
        return BIAS_PERIODS
    return ESTIMATED_BIAS_PERIODS if any(pair.epipolar for pair in own) else ACTIVITY_BIAS_PERIODS


def _supported(
    match: TimeCorrespondence,
    matches: Sequence[TimeCorrespondence],
    agreeing: Sequence[TimeCorrespondence],
) -> bool:
    """Whether enough pairs of both cameras agree with their clocks, so that it is no chance."""
    for name in (match.first, match.second):
        all_, own = (sum(name in (each.first, each.second) for each in some) for some in (matches, agreeing))
        if own < MIN_SUPPORT * all_ or (own == 1 and all_ > 1):
            return False
    return True


def _unconnected(others: Sequence[str], group: Sequence[str], seconds: float) -> str:
    names = ", ".join(repr(name) for name in others)
    rest = f"the cameras {', '.join(repr(name) for name in group)}" if len(group) > 1 else "any other camera"
    return (
        f"What moves before {names} cannot be recognised in the motion before {rest}, so their clocks are not "
        f"connected; the shortest take has {seconds:.1f} s: film ten seconds of motion that all see (a person who "
        "walks and claps), give the calibration, or synchronise by audio or timestamps.csv."
    )


def _whole(pair: PairSignals) -> list[TimeCorrespondence]:
    one, other = pair.signals
    min_overlap = max(MIN_SAMPLES, round(MIN_OVERLAP * min(len(one.values), len(other.values))))
    lag = best_lag(one, other, min_overlap=min_overlap)
    if lag is None or lag.peak < MIN_PEAK or lag.rival > RIVAL_RATIO * lag.judged:
        return []
    if not pair.epipolar and lag.judged < CHANCE_DEVIATIONS * chance_deviation(one, other):
        return []
    if pair.estimated and (lag.peak < ESTIMATED_PEAK or lag.judged < CONTROL_RATIO * _control(pair, min_overlap)):
        return []
    return [_match(pair, lag.middle, lag.seconds, lag.sigma_seconds, lag.judged / max(lag.rival, 0.1))]


def _control(pair: PairSignals, min_overlap: int) -> float:
    """The best correlation when lines are paired wrongly: a right geometry does better than that."""
    one, other = pair.signals
    half = other.values.shape[1] // 2
    wrong = (other.values[:, ::-1], np.roll(other.values, half, 1), np.roll(other.values[:, ::-1], half, 1))
    lags = [best_lag(one, replace(other, values=values), min_overlap=min_overlap) for values in wrong]
    return max((lag.judged for lag in lags if lag is not None), default=0.0)


def _near(pair: PairSignals, near: Solution, edges: NDArray[np.float64] | None) -> list[TimeCorrespondence]:
    """The correspondence of a whole take near known clocks.

    Where there are blocks it has its changes without each of them and with the shapes of ``correlation.py``: an event
    that is shorter than a frame lies on one of two frames, so that the peak of few such events is that of the majority,
    whichever block is left out.
    """
    one, other = pair.signals
    expected = _expected(pair, near)
    reach = NEAR_PERIODS * one.step
    start, end = max(one.start, other.start - expected), min(one.end, other.end - expected)
    cut = one.cut(start, end), other.cut(start + expected - reach, end + expected + reach)
    if min(len(signal.values) for signal in cut) < MIN_SAMPLES:
        return []
    min_overlap = max(MIN_SAMPLES, round(0.8 * len(cut[0].values) - 2 * NEAR_PERIODS))
    lag = best_lag(*cut, within=(expected - reach, expected + reach), min_overlap=min_overlap)
    if lag is None or lag.peak < MIN_PEAK or abs(lag.seconds - expected) >= reach - one.step / 2:
        return []
    match = _match(pair, lag.middle, lag.seconds, lag.sigma_seconds, lag.peak)
    if edges is None:
        return [match]
    own = edges - near.offsets[pair.first]
    line = fitted_line(one, other, expected_seconds=expected, edges=own, rates=False)
    difference = 0.0 if line is None else line.lag_seconds - lag.seconds
    return [replace(match, changes=(*lag_changes(*cut, lag.seconds, own).tolist(), difference))]


def _along(pair: PairSignals, near: Solution, edges: NDArray[np.float64]) -> list[TimeCorrespondence]:
    """Two correspondences for a line of lags over the take: they are apart by as much as its blocks, so that their
    errors are independent; one where the take does not determine the drift."""
    one, other = pair.signals
    line = fitted_line(one, other, expected_seconds=_expected(pair, near), edges=edges - near.offsets[pair.first])
    if line is None:
        return []
    min_overlap = MIN_LINE_SIGMA * one.step if pair.epipolar else one.step / 2
    sigma = max(line.lag_sigma, min_overlap)
    if line.rate is None:
        return [_line_match(pair, line, 0.0, sigma)]
    sigma = max(sigma, line.rate_sigma * line.spread_seconds)
    return [_line_match(pair, line, side * line.spread_seconds, 2**0.5 * sigma) for side in (-1.0, 1.0)]


def _line_match(pair: PairSignals, line: Line, after: float, sigma: float) -> TimeCorrespondence:
    at = line.middle + after
    changes = line.lag_changes + after * line.rate_changes
    lag = line.lag_seconds + after * (line.rate or 0.0)
    weight = 4.0 if pair.epipolar else 1.0
    return TimeCorrespondence(pair.first, pair.second, at, at + lag, sigma, weight, tuple(changes.tolist()))


def _expected(pair: PairSignals, near: Solution) -> float:
    """The lag by known clocks whose rates are 1."""
    return near.offsets[pair.first] - near.offsets[pair.second]


def _match(pair: PairSignals, middle: float, seconds: float, sigma: float, confidence: float) -> TimeCorrespondence:
    weight = confidence * (4.0 if pair.epipolar else 1.0)
    return TimeCorrespondence(pair.first, pair.second, middle, middle + seconds, OPTIMISM * sigma, weight)

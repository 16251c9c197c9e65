# SPDX-License-Identifier: Apache-2.0
"""Instants that pairs of cameras share, from what moves in their pictures.

Without geometry the activity of whole pictures is compared, which is good to a frame where enough happens. With
epipolar geometry signals of corresponding lines are compared, which is good to a tenth of a frame for one pair. A first
round considers all lags; the second one looks near those that most pairs agree on, and, in takes that are long enough,
for drift.

What changes on an epipolar line at an instant changes on the corresponding line of the other view at the same instant,
whatever the depth. So the changes of each view are summed over bundles of corresponding lines, which gives a signal for
each bundle that both views see at the same time, without matching a point. (Motion barcodes of lines: Ben-Artzi,
Kasten, Peleg and Werman, CVPR 2016; frontier points of silhouettes, which both views see on the same line: Hartley and
Zisserman, chapter 9.) The geometry comes from a calibration, or from what stands still in the pictures.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from structgstream.data.images import opencv, reduced_picture
from structgstream.data.lenses import LensCamera
from structgstream.data.matching import Features, connected_groups, mutual_matches, sift_features
from structgstream.data.timeline import period_seconds
from structgstream.errors import CaptureError
from structgstream.geometry import Floats, cross_matrices
from structgstream.preparation.synchronization.correlation import (
    Line,
    Signal,
    best_lag,
    chance_deviation,
    fitted_line,
    lag_changes,
    resampled,
)
from structgstream.preparation.synchronization.solving import Solution, TimeCorrespondence, camera_pairs, solve_clocks

CHANGES_SIDE = 160  # of reduced pictures, pixels: events are compared along lines, so positions need not be finer
SMOOTHING = 1.0  # standard deviation, reduced pixels
SAMPLED = 100  # frames whose noise is measured
NOISE_FACTOR, MIN_NOISE = 4.0, 0.5  # changes below this many times the median change are noise
MAX_CHANGE = 30.0  # larger changes count as this one: a bright shirt is not more of an event than a dark one
UNITS = 4  # of stored changes in a grey level
STILL = 5e-4  # share of MAX_CHANGE of a mean change below which nothing moves


@dataclass(frozen=True)
class Changes:
    """Changes of a camera's pictures."""

    amounts: NDArray[np.uint8]
    """``[T - 1, h, w]`` uint8: change from a frame to the next one above noise, in quarters of a grey level."""
    times: Floats  # ``[T - 1]`` seconds by the camera's clock, halfway between both frames
    size: tuple[int, int]  # width and height of the camera's pictures, pixels

    @property
    def activity(self) -> Floats:
        """``[T - 1, 1]``: mean over the picture of the square roots of changes."""
        return np.sqrt(self.amounts, dtype=np.float32).mean((1, 2), dtype=np.float64)[:, None]

    @property
    def moving(self) -> bool:
        """Whether anything moves."""
        return len(self.amounts) > 1 and float(self.amounts.mean()) > STILL * MAX_CHANGE * UNITS


def picture_changes(pictures: Iterable[NDArray[np.uint8]], stamps: Floats) -> Changes:
    """Changes of pictures ``[H, W, 3]`` that follow each other at ``stamps`` ``[T]``; only reduced ones stay."""
    reduced: list[NDArray[np.uint8]] = []
    size = (0, 0)
    for picture in pictures:
        size = (picture.shape[1], picture.shape[0])
        reduced.append(reduced_grey(picture))
    return reduced_changes(reduced, stamps[: len(reduced)], size)


def reduced_grey(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A picture ``[H, W, 3]`` as grey ``[h, w]`` whose longer side is at most :data:`CHANGES_SIDE`."""
    cv2 = opencv()
    # Reduced first: grey of a large picture would take longer than all else.
    return cv2.cvtColor(reduced_picture(picture, CHANGES_SIDE), cv2.COLOR_RGB2GRAY)


def reduced_changes(reduced: Sequence[NDArray[np.uint8]], stamps: Floats, size: tuple[int, int]) -> Changes:
    """Changes of reduced pictures ``[h, w]`` at ``stamps`` ``[T]`` of a camera of this width and height."""
    if len(reduced) < 2:
        return Changes(np.zeros((0, 1, 1), np.uint8), np.zeros(0), size)
    cv2 = opencv()
    noise = _noise(reduced)
    amounts = np.empty((len(reduced) - 1, *reduced[0].shape), np.uint8)
    before = cv2.GaussianBlur(reduced[0].astype(np.float32), (0, 0), SMOOTHING)
    for index, grey in enumerate(reduced[1:]):
        smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), SMOOTHING)
        above = np.clip(np.abs(smooth - before) - noise, 0, MAX_CHANGE)
        amounts[index] = np.rint(above * UNITS)
        before = smooth
    return Changes(amounts, (stamps[1:] + stamps[:-1]) / 2, size)


def _noise(reduced: Sequence[NDArray[np.uint8]]) -> float:
    """The change that counts as noise: a multiple of the median one, of some of the frames."""
    cv2 = opencv()
    firsts = np.unique(np.linspace(0, len(reduced) - 2, min(len(reduced) - 1, SAMPLED)).astype(int))
    steps = []
    for first in firsts.tolist():
        pair = [cv2.GaussianBlur(grey.astype(np.float32), (0, 0), SMOOTHING) for grey in reduced[first : first + 2]]
        steps.append(np.abs(pair[1] - pair[0]))
    return NOISE_FACTOR * max(float(np.median(np.stack(steps))), MIN_NOISE)


Straighten = Callable[[Floats], Floats]
"""From pixels ``[S, 2]`` as filmed to points that obey the fundamental matrix; NaN where the lens has no inverse."""

BUNDLES = 64
MIN_SHARE = 0.25  # of the pixels of the view that sees less of the common lines
SAME_PLACE = 1e-6  # distance of cameras at one place, as a share of theirs to the origin
FEATURES = 3000
FEATURES_SIDE = 960  # of pictures in which static features are looked for, pixels
RATIO = 0.8
INLIER_SHARE = 1 / 640  # of the picture's longer side
MIN_INLIERS = 16


@dataclass(frozen=True)
class PairGeometry:
    """Epipolar geometry of two views."""

    F: Floats  # ``[3, 3]`` with ``x2^T F x1 = 0`` for homogeneous points
    straighten: tuple[Straighten, Straighten]  # for each view, from filmed pixels to those points
    estimated: bool = False  # whether it is an estimate from pictures that may be wrong


def line_signals(first: Changes, second: Changes, geometry: PairGeometry) -> tuple[Floats, Floats] | None:
    """Signals ``[T1, B]`` and ``[T2, B]`` of the bundles that both views see; None if these are too few.

    Square roots are taken, so that a signal shows where something moves rather than how much.
    """
    angles = _angles(first, second, geometry)
    cut = _gap(np.concatenate(angles))
    one, other = ((angle - cut) % np.pi for angle in angles)
    ranges = [np.nanquantile(each, (0.005, 0.995)) for each in (one, other)]
    low, high = max(low for low, _ in ranges), min(high for _, high in ranges)
    if not high > low:
        return None
    if min(((each >= low) & (each <= high)).mean() for each in (one, other)) < MIN_SHARE:
        return None
    # Bundles of equally many pixels: lines fan out, and a bundle of few pixels is noise.
    both = np.concatenate([each[(each >= low) & (each <= high)] for each in (one, other)])
    edges = np.quantile(both, np.linspace(0, 1, BUNDLES + 1))
    return _summed(first, one, edges), _summed(second, other, edges)


def _angles(first: Changes, second: Changes, geometry: PairGeometry) -> tuple[Floats, Floats]:
    """For each pixel of both reduced views its epipolar line in the second view, as an angle modulo pi in the pencil of
    these lines."""
    F = geometry.F / np.linalg.norm(geometry.F)
    epipole = np.linalg.svd(F)[0][:, 2]  # of the second view: e2^T F = 0
    of_first = _points(first, geometry.straighten[0]) @ F.T
    of_second = np.cross(epipole, _points(second, geometry.straighten[1]))
    # Lines of a pencil have two coordinates; those in which the view's lines are spread evenly keep angles well scaled.
    seen = of_second[np.isfinite(of_second).all(1)]
    values, vectors = np.linalg.eigh(seen.T @ seen / len(seen))
    coordinates = vectors[:, 1:] / np.sqrt(np.maximum(values[1:], 1e-12 * values[2]))
    one, other = of_first @ coordinates, of_second @ coordinates
    return np.arctan2(one[:, 0], one[:, 1]) % np.pi, np.arctan2(other[:, 0], other[:, 1]) % np.pi


def _points(view: Changes, straighten: Straighten) -> Floats:
    """Homogeneous points of the reduced pixels' centres."""
    _, height, width = view.amounts.shape
    x, y = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
    points = straighten(np.stack([x.ravel() * view.size[0], y.ravel() * view.size[1]], axis=1))
    return np.concatenate([points, np.ones((len(points), 1))], axis=1)


def _gap(angles: Floats) -> float:
    """The angle in the middle of the widest range modulo pi that no line has."""
    ordered = np.sort(angles[np.isfinite(angles)])
    gaps = np.diff(ordered, append=ordered[0] + np.pi)
    widest = int(gaps.argmax())
    return float(ordered[widest] + gaps[widest] / 2) % np.pi


def _summed(view: Changes, angles: Floats, edges: Floats) -> Floats:
    """Square roots of the mean change ``[T, B]`` in each bundle."""
    from scipy.sparse import csr_matrix

    bundle = np.searchsorted(edges, angles, side="right") - 1
    inside = np.isfinite(angles) & (bundle >= 0) & (bundle < BUNDLES)
    pixels = np.flatnonzero(inside)
    shape = (len(angles), BUNDLES)
    membership = csr_matrix((np.ones(len(pixels), np.float32), (pixels, bundle[inside])), shape=shape)
    counts = np.maximum(np.bincount(bundle[inside], minlength=BUNDLES), 1)
    flat = view.amounts.reshape(len(view.amounts), -1)
    sums = np.concatenate(
        [part.astype(np.float32) @ membership for part in np.array_split(flat, max(len(flat) // 200, 1))]
    )
    return np.sqrt(sums / counts, dtype=np.float64)


@dataclass(frozen=True)
class CalibratedGeometry:
    """Epipolar geometry of calibrated cameras; the cameras of a pair need different positions."""

    cameras: Mapping[str, LensCamera]

    def pair(self, first: str, second: str, /) -> PairGeometry | None:
        """None if a camera has no calibration, or both are at one place."""
        if first not in self.cameras or second not in self.cameras:
            return None
        one, other = self.cameras[first], self.cameras[second]
        relative = other.camera.viewmat.numpy() @ np.linalg.inv(one.camera.viewmat.numpy())
        size = max(float(np.linalg.norm(own.camera.viewmat.numpy()[:3, 3])) for own in (one, other))
        if not np.linalg.norm(relative[:3, 3]) > SAME_PLACE * size:
            return None
        essential = cross_matrices(relative[:3, 3]) @ relative[:3, :3]
        return PairGeometry(essential, (one.to_normalized, other.to_normalized))


@dataclass(frozen=True)
class StaticGeometry:
    """Fundamental matrices from features of what stands still; lenses are taken as pinholes."""

    features: Mapping[str, Features]
    sizes: Mapping[str, tuple[int, int]]

    def pair(self, first: str, second: str, /) -> PairGeometry | None:
        """None if the views have too few features in common."""
        one, other = self.features[first], self.features[second]
        if min(len(one.pixels), len(other.pixels)) < MIN_INLIERS:
            return None
        matches = mutual_matches(one.descriptors, other.descriptors, ratio=RATIO)
        if len(matches) < MIN_INLIERS:
            return None
        F, inliers = opencv().findFundamentalMat(
            one.pixels[matches[:, 0]],
            other.pixels[matches[:, 1]],
            opencv().USAC_MAGSAC,
            max(self.sizes[first] + self.sizes[second]) * INLIER_SHARE,
            0.999,
            5000,
        )
        if F is None or F.shape != (3, 3) or int(inliers.sum()) < MIN_INLIERS:
            return None
        return PairGeometry(F, (np.asarray, np.asarray), estimated=True)


Geometry = CalibratedGeometry | StaticGeometry


def static_features(pictures: list[NDArray[np.uint8]]) -> Features:
    """Features of the median of pictures ``[H, W, 3]`` of one camera, in pixels of these."""
    height, width = pictures[0].shape[:2]
    still = np.median([reduced_picture(picture, FEATURES_SIDE) for picture in pictures], axis=0).astype(np.uint8)
    found = sift_features(still, count=FEATURES, contrast=0.005)
    return Features(found.pixels * [width / still.shape[1], height / still.shape[0]], found.descriptors)


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
NEAR_BLOCKS, NEAR_SAMPLES = 6, 8
"""Largest number of blocks of shorter takes, left out one by one, and smallest number of samples of each."""
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


def pair_signals(changes: Mapping[str, Changes], geometry: Geometry) -> list[PairSignals]:
    """Signals of all pairs of cameras in which something moves: of epipolar lines where the geometry is known."""
    moving = [name for name, change in changes.items() if change.moving]
    found = []
    for first, second in combinations(moving, 2):
        one, other = changes[first], changes[second]
        step = min(period_seconds(one.times), period_seconds(other.times))
        pair = geometry.pair(first, second)
        values = line_signals(one, other, pair) if pair else None
        both = values or (one.activity, other.activity)
        signals = resampled(both[0], one.times, step=step), resampled(both[1], other.times, step=step)
        epipolar = values is not None
        estimated = epipolar and pair is not None and pair.estimated
        found.append(PairSignals(first, second, signals, epipolar, estimated))
    return found


def motion_correspondences(pairs: Sequence[PairSignals], *, near: Solution | None = None) -> list[TimeCorrespondence]:
    """Time correspondences from signals of pairs; of all lags, or of those and of drift ``near`` known clocks."""
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
    """Clocks by motion, with rates other than 1 where ``drift`` is considered.

    Args:
        takes: camera to the first and last second of its take.
        pairs: what :func:`pair_signals` gives.
        slack_seconds: half a frame period.

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
    match: TimeCorrespondence, matches: Sequence[TimeCorrespondence], agreeing: Sequence[TimeCorrespondence]
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
        f"The motion in the pictures of {names} is not found again in those of {rest}, so their clocks are not "
        f"connected. The beginnings of the takes were compared, {seconds:.1f} s of the shortest: film ten seconds of "
        "motion there that all see (a person who walks and claps), give the calibration, or synchronise by audio or "
        "timestamps.csv."
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
    sigma = max(line.lag_sigma, MIN_LINE_SIGMA * one.step if pair.epipolar else one.step / 2)
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

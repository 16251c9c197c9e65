# SPDX-License-Identifier: Apache-2.0
"""Clocks of all cameras from instants that pairs of cameras share.

A time correspondence states that second ``first_seconds`` of one camera's clock was second ``second_seconds`` of
another's. With ``common = offset + rate * stamp`` it is linear in both clocks, so all of them are solved by one
weighted least squares. Wrong ones do not agree around loops of cameras: a start is chosen among spanning trees of the
graph of cameras by how many correspondences it explains, and the weights are those of Tukey's biweight (iteratively
reweighted least squares).
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from structgstream.data.matching import Pair
from structgstream.geometry import Floats, Indices

TREES = 200
ITERATIONS = 30
# Standard deviation of rates: quartz clocks are within 1e-4, but 29.97 and 30 frames a second are 1e-3 apart.
RATE_PRIOR = 5e-4
RATE_SIGMAS, RATE_EFFECT_SECONDS = 3.0, 1e-3  # a rate other than 1 is taken if it exceeds both
SIGMAS = 5.0  # correspondences further off than this many standard deviations are wrong


@dataclass(frozen=True)
class TimeCorrespondence:
    """One instant by the clocks of two cameras."""

    first: str  # name of a camera
    second: str  # name of another
    first_seconds: float  # the instant by the first camera's clock
    second_seconds: float  # the same instant by the second camera's
    sigma_seconds: float  # standard error of their difference
    confidence: float = 1.0  # how distinct the match is, larger is better; only orders correspondences
    changes: tuple[float, ...] = ()
    """By how much the second camera's second grows without each block of the take, the same blocks for all
    correspondences; empty where it is not known. They show errors that those of a camera share."""


@dataclass(frozen=True)
class Solution:
    """Clocks that agree with most correspondences."""

    offsets: Mapping[str, float]  # camera to seconds; the first camera's is 0
    rates: Mapping[str, float]  # camera to rate; the first camera's is 1
    sigmas: Mapping[str, float]
    """Camera to the standard error of its common time at the ends of its take, relative to the mean of all cameras."""
    agreeing: tuple[bool, ...]  # for each correspondence whether it agrees


@dataclass(frozen=True)
class _Graph:
    """Correspondences as arrays; ``times`` are relative to the middle of each camera's take, ``changes`` ``[K, M]`` are
    those of the differences without each block."""

    first: Indices
    second: Indices
    first_times: Floats
    second_times: Floats
    differences: Floats
    sigmas: Floats
    changes: Floats
    cameras: int


def camera_pairs(matches: Iterable[TimeCorrespondence]) -> list[Pair]:
    """The cameras of each correspondence."""
    return [(match.first, match.second) for match in matches]


def solve_clocks(
    takes: Mapping[str, tuple[float, float]],
    matches: Sequence[TimeCorrespondence],
    *,
    drift: bool,
    slack_seconds: float,
) -> Solution:
    """The clocks of all cameras, with rates other than 1 where ``drift`` is considered.

    Args:
        takes: camera to the first and last second of its take, by its own clock.
        matches: instants of pairs; they must connect all cameras.
        slack_seconds: how far right correspondences may be off before rates are known.
    """
    names = list(takes)
    middles = np.array([(start + end) / 2 for start, end in takes.values()])
    halves = np.array([(end - start) / 2 for start, end in takes.values()])
    graph = _graph(names, matches, middles)
    offsets = _consensus(graph, [match.confidence for match in matches], slack_seconds)
    corrections = np.zeros(len(names))
    free = np.zeros(len(names), bool)
    unknown = np.zeros(len(names))
    offsets, _, weights, covariance = _reweighted(graph, offsets, corrections, free, slack_seconds)
    if drift:
        offsets, corrections, weights, covariance, unknown = _with_rates(graph, offsets, halves, slack_seconds)
    variances = _relative_variances(covariance, len(names))
    spread = np.sqrt(variances[0] + halves**2 * (variances[1] + unknown))
    rates = (1 + corrections) / (1 + corrections[0])
    at_zero = offsets - middles * corrections
    at_zero = (at_zero - at_zero[0]) / (1 + corrections[0])
    return Solution(
        offsets=dict(zip(names, at_zero.tolist(), strict=True)),
        rates=dict(zip(names, rates.tolist(), strict=True)),
        sigmas=dict(zip(names, spread.tolist(), strict=True)),
        agreeing=tuple((weights > 0).tolist()),
    )


def _graph(names: list[str], matches: Sequence[TimeCorrespondence], middles: Floats) -> _Graph:
    position = {name: index for index, name in enumerate(names)}
    first = np.array([position[match.first] for match in matches], np.intp)
    second = np.array([position[match.second] for match in matches], np.intp)
    at_first = np.array([match.first_seconds for match in matches])
    at_second = np.array([match.second_seconds for match in matches])
    sigmas = np.array([match.sigma_seconds for match in matches])
    changes = np.zeros((max((len(match.changes) for match in matches), default=0), len(matches)))
    for number, match in enumerate(matches):
        changes[: len(match.changes), number] = np.negative(match.changes)
    return _Graph(
        first,
        second,
        at_first - middles[first],
        at_second - middles[second],
        at_first - at_second,
        sigmas,
        changes,
        len(names),
    )


def _residuals(graph: _Graph, offsets: Floats, corrections: Floats) -> Floats:
    """Common time by the first camera minus that by the second, for each correspondence."""
    one = offsets[graph.first] + corrections[graph.first] * graph.first_times
    other = offsets[graph.second] + corrections[graph.second] * graph.second_times
    return one - other + graph.differences


def _consensus(graph: _Graph, confidences: Sequence[float], slack_seconds: float) -> Floats:
    """Offsets along the spanning tree that leaves the smallest truncated residuals.

    The first tree takes correspondences by confidence, the others by confidence times a random factor.
    """
    generator = np.random.default_rng(0)
    reach = SIGMAS * np.hypot(graph.sigmas, slack_seconds / 2)
    share = np.array(confidences) / np.bincount(_pair_numbers(graph))[_pair_numbers(graph)]
    best, best_cost = np.zeros(graph.cameras), np.inf
    for trial in range(TREES if len(graph.first) >= graph.cameras else 1):
        chance = generator.exponential(size=len(share)) if trial else np.ones(len(share))
        offsets = _along_tree(graph, np.argsort(-share * chance))
        off = np.abs(_residuals(graph, offsets, np.zeros(graph.cameras)))
        cost = float((share * np.minimum(off / reach, 1.0)).sum())
        if cost < best_cost:
            best, best_cost = offsets, cost
    return best


def _along_tree(graph: _Graph, order: Indices) -> Floats:
    """Offsets that satisfy the correspondences of a spanning tree, taken greedily in ``order`` (Kruskal)."""
    group = np.arange(graph.cameras)
    offsets = np.zeros(graph.cameras)
    for match in order:
        one, other = graph.first[match], graph.second[match]
        if group[one] == group[other]:
            continue
        moved = group == group[other]
        # The whole group of the second camera moves, so that correspondences that joined it stay satisfied.
        offsets[moved] += offsets[one] + graph.differences[match] - offsets[other]
        group[moved] = group[one]
    return offsets


def _reweighted(
    graph: _Graph, offsets: Floats, corrections: Floats, free: NDArray[np.bool_], slack_seconds: float
) -> tuple[Floats, Floats, Floats, Floats]:
    """Offsets, rate corrections of the cameras that are ``free``, weights of correspondences, and the covariance of
    both.

    The slack shrinks to the spread that the correspondences show.
    """
    slack = slack_seconds
    weights = np.ones(len(graph.first))
    covariance = np.zeros((2 * graph.cameras, 2 * graph.cameras))
    for _ in range(ITERATIONS):
        off = _residuals(graph, offsets, corrections)
        scale = np.hypot(graph.sigmas, slack)
        share = np.abs(off) / (SIGMAS * scale)
        weights = np.where(share < 1, (1 - share**2) ** 2, 0.0) / scale**2
        moved, covariance = _step(graph, off, weights, scale, corrections, free)
        offsets, corrections = offsets + moved[: graph.cameras], corrections + moved[graph.cameras :]
        inliers = weights > 0
        spread = slack
        if inliers.any():
            freedom = max(int(inliers.sum()) - graph.cameras + 1, 1) / int(inliers.sum())
            left = np.abs(_residuals(graph, offsets, corrections)[inliers])
            spread = 1.4826 * float(np.median(left)) / freedom**0.5
            slack = min(slack, max(spread, slack / 2))
        if np.abs(moved[: graph.cameras]).max() < 1e-8 and slack < 1.05 * max(spread, 1e-9):
            break
    return offsets, corrections, weights, covariance


def _step(
    graph: _Graph, off: Floats, weights: Floats, scale: Floats, corrections: Floats, free: NDArray[np.bool_]
) -> tuple[Floats, Floats]:
    """One Gauss-Newton step ``[2C]`` (offsets, rate corrections) and the covariance ``[2C, 2C]``.

    The mean of the offsets and that of the free rates stay; rates have a prior.
    """
    count, rows = graph.cameras, np.arange(len(off))
    design = np.zeros((len(off), 2 * count))
    design[rows, graph.first] = 1
    design[rows, graph.second] = -1
    design[rows, count + graph.first] += graph.first_times
    design[rows, count + graph.second] -= graph.second_times
    used = np.concatenate([np.ones(count, bool), free])
    normal = (design * weights[:, None]).T @ design
    right = -(design * weights[:, None]).T @ off
    prior = np.concatenate([np.zeros(count), np.full(count, 1 / RATE_PRIOR**2)])
    normal += np.diag(prior)
    right -= prior * np.concatenate([np.zeros(count), corrections])
    free_columns = np.flatnonzero(used)
    inverse = np.linalg.pinv(normal[np.ix_(free_columns, free_columns)], rcond=1e-13, hermitian=True)
    moved, covariance = np.zeros(2 * count), np.zeros((2 * count, 2 * count))
    moved[free_columns] = inverse @ right[free_columns]
    shared = _shared(inverse @ (design * weights[:, None]).T[free_columns] @ graph.changes.T)
    covariance[np.ix_(free_columns, free_columns)] = inverse * _inflation(graph, off, weights, scale) + shared
    return moved, covariance


def _shared(changes: Floats) -> Floats:
    """Covariance ``[N, N]`` by the jackknife of numbers whose changes without each of K blocks are ``[N, K]``."""
    count = changes.shape[1]
    if count < 2:
        return np.zeros((len(changes), len(changes)))
    centred = changes - changes.mean(1, keepdims=True)
    return (count - 1) / count * centred @ centred.T


def _inflation(graph: _Graph, off: Floats, weights: Floats, scale: Floats) -> float:
    """How much larger variances are than stated: the larger one of the reduced chi-squares of correspondences and of
    pairs, at least 1.

    Correspondences of one pair share its error (sound reaches both microphones by the same ways), so pairs are judged
    by their means.
    """
    inliers = weights > 0
    matches, pairs = int(inliers.sum()), np.unique(_pair_numbers(graph)[inliers])
    factor = 1.0
    if matches > graph.cameras:
        factor = max(factor, float(((off / scale)[inliers] ** 2).sum()) / (matches - graph.cameras + 1))
    if len(pairs) > graph.cameras - 1:
        numbers = _pair_numbers(graph)
        total = np.bincount(numbers, weights)[pairs]
        mean = np.bincount(numbers, weights * off)[pairs] / np.maximum(total, 1e-300)
        factor = max(factor, float((total * mean**2).sum()) / (len(pairs) - graph.cameras + 1))
    return factor


def _pair_numbers(graph: _Graph) -> Indices:
    low, high = np.minimum(graph.first, graph.second), np.maximum(graph.first, graph.second)
    return low * graph.cameras + high


def _with_rates(
    graph: _Graph, offsets: Floats, halves: Floats, slack_seconds: float
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """The solution with rates of the cameras whose rate matters: significant, and more than a millisecond in the
    take; and the mean squares that the rates of the others may have."""
    free = np.ones(graph.cameras, bool)
    zeros, unknown = np.zeros((2, graph.cameras))
    start = offsets
    while True:
        offsets, corrections, weights, covariance = _reweighted(graph, start, zeros, free, slack_seconds)
        errors = np.sqrt(_relative_variances(covariance, graph.cameras)[1])
        # Rates are relative: compared with the median, cameras of one kind of clock keep rate 1 together.
        relative = corrections - (np.median(corrections) if free.all() else 0.0)
        effect = np.abs(relative) * 2 * halves
        strength = np.minimum(np.abs(relative) / (RATE_SIGMAS * errors + 1e-300), effect / RATE_EFFECT_SECONDS)
        weak = np.flatnonzero(free & (strength < 1))
        if not len(weak):
            return offsets, corrections, weights, covariance, unknown
        # Half of them at a time: fixed to 1, a rate that is nearly significant would bend those of its partners.
        fixed = weak[np.argsort(strength[weak])][: (len(weak) + 1) // 2]
        unknown[fixed] = relative[fixed] ** 2 + errors[fixed] ** 2
        free[fixed] = False


def _relative_variances(covariance: Floats, count: int) -> tuple[Floats, Floats]:
    """Variances of offsets and of rates relative to their means: only differences of clocks are observed."""
    centering = np.eye(count) - 1 / count
    offsets, rates = covariance[:count, :count], covariance[count:, count:]
    common = centering if np.diag(rates).all() else np.eye(count)  # a rate that is fixed is what others are relative to
    return np.diag(centering @ offsets @ centering), np.diag(common @ rates @ common.T)

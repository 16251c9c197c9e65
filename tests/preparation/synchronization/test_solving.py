# SPDX-License-Identifier: Apache-2.0
"""Clocks from ties with errors, wrong ties and drift."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from structgstream.data.timeline import Clock
from structgstream.preparation.synchronization.solving import Solution, TimeCorrespondence, solve_clocks

TRUTH = {"a": Clock(0.0), "b": Clock(1.25), "c": Clock(-0.5), "d": Clock(3.0)}
TAKES = dict.fromkeys(TRUTH, (0.0, 60.0))


def matches_of(
    clocks: Mapping[str, Clock], *, sigma: float, wrong: float = 0.0, each: int = 4, seed: int = 0
) -> list[TimeCorrespondence]:
    """``each`` ties of every pair, with normal errors; a share is wrong by up to ten seconds."""
    generator = np.random.default_rng(seed)
    names, matches = list(clocks), []
    for i, first in enumerate(names):
        for second in names[i + 1 :]:
            for instant in np.linspace(5, 55, each):
                stamps = [(instant - clocks[name].offset_seconds) / clocks[name].rate for name in (first, second)]
                error = generator.uniform(-10, 10) if generator.random() < wrong else generator.normal(0, sigma)
                matches.append(TimeCorrespondence(first, second, stamps[0], stamps[1] + error, sigma))
    return matches


def errors(solution: Solution, truth: Mapping[str, Clock], at: float) -> np.ndarray:
    """Errors of common times at a stamp, relative to their mean."""
    found = np.array([solution.offsets[name] + solution.rates[name] * at for name in truth])
    first, clocks = next(iter(truth.values())), truth.values()
    right = np.array([(clock.offset_seconds + clock.rate * at - first.offset_seconds) / first.rate for clock in clocks])
    return (found - right) - (found - right).mean()


def test_exact_ties_give_the_clocks() -> None:
    solution = solve_clocks(TAKES, matches_of(TRUTH, sigma=1e-9), drift=True, slack_seconds=0.01)
    assert np.abs(errors(solution, TRUTH, 0.0)).max() < 1e-8
    assert set(solution.rates.values()) == {1.0}
    assert solution.offsets["a"] == 0


@pytest.mark.parametrize("wrong", [0.1, 0.3])
def test_wrong_ties_do_not_move_the_clocks(wrong: float) -> None:
    matches = matches_of(TRUTH, sigma=1e-3, wrong=wrong)
    solution = solve_clocks(TAKES, matches, drift=False, slack_seconds=0.01)
    assert np.abs(errors(solution, TRUTH, 0.0)).max() < 2e-3
    for match, agrees in zip(matches, solution.agreeing, strict=True):
        first, second = (TRUTH[name].offset_seconds for name in (match.first, match.second))
        off = first + match.first_seconds - second - match.second_seconds
        assert not (agrees and abs(off) > 0.1)


@pytest.mark.parametrize("stated", [1e-3, 1e-5])
def test_uncertainties_hold_and_errors_that_are_stated_too_small_are_corrected_by_the_spread(stated: float) -> None:
    """Errors over standard errors are standard normal over many trials: their mean square is near 1."""
    scores = []
    for seed in range(40):
        matches = [replace(match, sigma_seconds=stated) for match in matches_of(TRUTH, sigma=1e-3, seed=seed)]
        solution = solve_clocks(TAKES, matches, drift=False, slack_seconds=0.01)
        scores.append(errors(solution, TRUTH, 0.0) / np.array(list(solution.sigmas.values())))
    assert 0.5 < np.mean(np.square(scores)) < 1.7
    assert np.mean(np.abs(scores) < 3) > 0.95


def test_drift_is_found_where_it_matters() -> None:
    truth = {**TRUTH, "c": Clock(-0.5, 1 + 60e-6)}
    solution = solve_clocks(TAKES, matches_of(truth, sigma=2e-4), drift=True, slack_seconds=0.01)
    assert solution.rates["c"] - 1 == pytest.approx(60e-6, abs=10e-6)
    assert {solution.rates[name] for name in "abd"} == {1.0}
    for at in (0.0, 60.0):
        assert np.abs(errors(solution, truth, at)).max() < 5e-4


def test_drift_within_the_noise_is_no_drift() -> None:
    truth = {**TRUTH, "c": Clock(-0.5, 1 + 5e-6)}
    solution = solve_clocks(TAKES, matches_of(truth, sigma=1e-3), drift=True, slack_seconds=0.01)
    assert set(solution.rates.values()) == {1.0}


def test_a_rate_that_is_not_known_widens_what_is_stated() -> None:
    """One tie a pair, in the middle of the takes: rates are not observed, and the ends may be far off."""
    matches = matches_of(TRUTH, sigma=1e-3, each=1)
    matches = [
        replace(
            match,
            first_seconds=30.0,
            second_seconds=30.0 + match.second_seconds - match.first_seconds,
        )
        for match in matches
    ]
    unknown, none = (solve_clocks(TAKES, matches, drift=drift, slack_seconds=0.01) for drift in (True, False))
    assert set(unknown.rates.values()) == {1.0}
    assert max(none.sigmas.values()) < 2e-3
    assert min(unknown.sigmas.values()) > 5e-3


def test_errors_that_ties_of_a_camera_share_are_reported_by_its_blocks() -> None:
    """All ties of b are off alike; what they change by without each of ten blocks tells by how much."""
    scores = []
    for seed in range(40):
        errors_of_blocks = np.random.default_rng(1000 + seed).normal(0, 3e-3, 10)
        own, without = errors_of_blocks.mean(), (errors_of_blocks.sum() - errors_of_blocks) / 9
        matches = []
        for match in matches_of(TRUTH, sigma=1e-5, each=1, seed=seed):
            side = {match.first: -1.0, match.second: 1.0}.get("b", 0.0)
            shifted = replace(match, second_seconds=match.second_seconds + side * own)
            matches.append(replace(shifted, changes=tuple(side * (without - own))))
        solution = solve_clocks(TAKES, matches, drift=False, slack_seconds=0.01)
        scores.append(errors(solution, TRUTH, 0.0)[1] / solution.sigmas["b"])
    assert 0.5 < np.mean(np.square(scores)) < 1.6

# SPDX-License-Identifier: Apache-2.0
"""Means, spreads, differences seed by seed, and what may be concluded from them, by hand."""

import math
from dataclasses import replace

import pytest

from outcomes import outcome, outcomes
from structgstream_studies.experiments.summary import Spread, Summary, score_of, spread_of, summaries, verdict


def summary_of(key: str, *psnrs: float) -> Summary:
    return summaries(outcomes(key, psnrs))[key]


def test_a_spread_is_the_mean_and_the_sample_deviation() -> None:
    assert spread_of([1.0, 2.0, 6.0]) == Spread(3.0, math.sqrt((4 + 1 + 9) / 2), 3)
    assert spread_of([4.5]) == Spread(4.5, 0.0, 1)
    assert spread_of([]) is None
    assert Spread(0.0, 3.0, 9).standard_error == 1.0


def test_differences_are_taken_seed_by_seed() -> None:
    """Seeds lie 10 dB apart, the variant 0.1, 0.2 and 0.3 below."""
    full, variant = summary_of("full", 20.0, 30.0, 40.0), summary_of("v", 19.9, 29.8, 39.7)
    difference = variant.difference(full, "psnr")
    assert difference is not None
    assert difference.mean == pytest.approx(-0.2)
    assert difference.deviation == pytest.approx(0.1)
    assert difference.count == 3


def test_only_seeds_that_both_have_are_compared() -> None:
    full = summaries([outcome("full", 0, psnr=20.0), outcome("full", 7, psnr=50.0)])["full"]
    variant = summaries([outcome("v", 7, psnr=51.0), outcome("v", 8, psnr=0.0), outcome("v", 0, psnr=None)])["v"]
    assert variant.difference(full, "psnr") == Spread(1.0, 0.0, 1)
    assert summary_of("w", 1.0).difference(summaries([outcome("full", 5)])["full"], "psnr") is None


def test_a_score_is_a_mean_or_a_fact_of_the_file() -> None:
    one = outcome(
        "v", psnr=31.0, mean={"flip": None}, stream={"psnr_first": 33, "total_bytes": 5, "codec": "zstd", "x": {}}
    )
    assert score_of(one, "psnr") == 31.0
    assert score_of(one, "psnr_first") == 33.0
    assert [score_of(one, name) for name in ("flip", "codec", "x", "nothing")] == [None] * 4


def test_summaries_are_by_key_with_seeds_in_order() -> None:
    found = summaries([outcome("b", 2), outcome("a", 1), outcome("b", 0)])
    assert {key: list(summary.results) for key, summary in found.items()} == {"b": [0, 2], "a": [1]}
    assert found["b"].score("psnr") == Spread(30.0, 0.0, 2)
    assert found["b"].score("flip") is None


def test_a_curve_has_the_frames_that_all_seeds_have() -> None:
    frames = [[{"psnr": 1.0, "e": None}, {"psnr": 2.0, "e": 4.0}, {"psnr": 9.0}], [{"psnr": 3.0}, {"psnr": 2.0}]]
    found = summaries([outcome("v", seed, frames=row) for seed, row in enumerate(frames)])["v"]
    assert found.curve("psnr") == [Spread(2.0, math.sqrt(2.0), 2), Spread(2.0, 0.0, 2)]
    assert found.curve("e") == [None, Spread(4.0, 0.0, 1)]


@pytest.mark.parametrize(
    ("differences", "expected", "said"),
    [
        ((-0.1, -0.15, -0.2), -1.0, "reproduced"),
        ((-0.1, -0.15, -0.2), +0.04, "refuted"),
        ((0.1, 0.15, 0.2), +1.0, "reproduced"),
        ((0.1, 0.15, 0.2), -1.0, "refuted"),
        ((-0.2, -0.2), -1.0, "cannot be decided"),
        ((-0.2, -0.2, 0.01), -1.0, "cannot be decided"),
        # The same sign in all seeds, 3.5 standard errors from zero: chance in one of fourteen.
        ((-0.1, -0.2, -0.3), -1.0, "cannot be decided"),
        # 4.303 standard errors of (1, 1, x) reach the mean at x = 1.908: (2 + x) / 3 = 4.303 (x - 1) / 3.
        ((-1.0, -1.0, -1.90), -1.0, "reproduced"),
        ((-1.0, -1.0, -1.92), -1.0, "cannot be decided"),
    ],
    ids=[
        "below",
        "below, above expected",
        "above",
        "above, below expected",
        "two seeds",
        "mixed",
        "one sign",
        "clear",
        "unclear",
    ],
)
def test_a_claim_needs_three_seeds_and_a_t_test(differences: tuple[float, ...], expected: float, said: str) -> None:
    base = [10.0, 20.0, 30.0][: len(differences)]
    full = summary_of("full", *base)
    variant = summary_of("v", *(value + difference for value, difference in zip(base, differences)))
    assert verdict(variant, full, "psnr", expected_sign=expected) == said


def test_a_seed_without_the_score_tells_nothing() -> None:
    full, variant = summary_of("full", 1.0, 2.0, 3.0), summary_of("v", 2.0, 3.0, 4.0)
    assert verdict(variant, full, "psnr", expected_sign=1.0) == "reproduced"
    results = {**variant.results, 2: replace(variant.results[2], mean={"psnr": None})}
    assert verdict(replace(variant, results=results), full, "psnr", expected_sign=1.0) == "cannot be decided"
    assert verdict(variant, full, "flip", expected_sign=1.0) == "cannot be decided"

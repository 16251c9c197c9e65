# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from structgstream.preparation.calibration.lens_terms import ACROSS, FOCAL, TERMS, usual_prior

FREE = (FOCAL, ACROSS)
LENSES = 40


def rows(mean: float, differences: float) -> np.ndarray:
    found = np.zeros((LENSES, TERMS))
    found[:, ACROSS] = mean + differences * np.random.default_rng(0).normal(size=LENSES)
    return found


def test_an_offset_that_all_share_costs_less_than_as_large_ones_of_their_own() -> None:
    prior = usual_prior(np.zeros(LENSES, np.intp), FREE, fisheye=False)
    alike, each = np.zeros((LENSES, TERMS)), np.zeros((LENSES, TERMS))
    alike[:, ACROSS] = 0.01
    each[:, ACROSS] = 0.01 * (-1.0) ** np.arange(LENSES)
    assert prior.cost(alike) < 0.01 * prior.cost(each)


def test_how_far_lenses_differ_is_estimated() -> None:
    prior = usual_prior(np.zeros(LENSES, np.intp), FREE, fisheye=False)
    for differences in (0.001, 0.02):
        found, own = prior, rows(0.01, differences)
        for _ in range(20):
            found = found.updated(own, np.zeros((2 * LENSES, 2 * LENSES)), start=0, free=FREE)
        usual = 0.002  # and counts as two lenses
        expected = np.sqrt((2 * usual**2 + LENSES * differences**2) / (2 + LENSES))
        assert found.differences[0, 0] == pytest.approx(expected, rel=0.25)


def test_the_cost_has_the_gradient_and_the_curvature_that_are_added() -> None:
    prior = usual_prior(np.array([0, 0, 1, 1] * 10), FREE, fisheye=False)
    own, size = rows(0.01, 0.004), 2 * LENSES
    A, gradient = np.zeros((size, size)), np.zeros(size)
    prior.add(A, gradient, own, start=0, free=FREE)
    step = np.zeros((LENSES, TERMS))
    step[:, ACROSS] = np.random.default_rng(1).normal(size=LENSES) * 1e-3
    flat = step[:, list(FREE)].ravel()
    assert prior.cost(own + step) - prior.cost(own) == pytest.approx(gradient @ flat + flat @ A @ flat / 2)

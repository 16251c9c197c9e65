# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from structgstream.data.calibration import rotation_matrix
from structgstream.preparation.calibration.bundle import BodyObservations, Bundle, Parameters, linearized, solved
from structgstream.preparation.calibration.lens_terms import ACROSS, DOWN, FOCAL, K1, K2, K3, TERMS, usual_prior

CAMERAS, POINTS = 6, 120
FREE = (FOCAL, ACROSS, DOWN, K1, K2, K3)


def parameters(*, rotating: bool) -> tuple[Bundle, Parameters]:
    """Cameras around points, or around a board that is turned about; pixels without noise."""
    rng = np.random.default_rng(0)
    rotations, translations = [], []
    for angle in np.linspace(-0.9, 0.9, CAMERAS):
        rotations.append(rotation_matrix(np.array([0.1 * rng.normal(), angle, 0.0])))
        translations.append(np.array([0.0, 0.0, 4.0]) + 0.2 * rng.normal(size=3))
    rows = np.zeros((CAMERAS, TERMS))
    rows[:, FOCAL], rows[:, [ACROSS, DOWN]] = 0.05 * rng.normal(size=CAMERAS), [0.008, -0.006]
    rows[:, [K1, K2, K3]] = [0.2, -0.5, 0.4]
    bodies = 12 if rotating else POINTS
    body_rotations = np.stack(
        [rotation_matrix(0.4 * rng.normal(size=3)) if rotating else np.eye(3) for _ in range(bodies)]
    )
    body_positions = rng.uniform(-1, 1, (bodies, 3))
    corners = np.array([[x, y, 0.0] for x in np.linspace(-0.5, 0.5, 5) for y in np.linspace(-0.4, 0.4, 4)])
    each = len(corners) if rotating else 1
    camera, body = (grid.ravel() for grid in np.mgrid[:CAMERAS, : bodies * each])
    offset = corners[body % each] if rotating else np.zeros((len(body), 3))
    sizes = np.tile([640.0, 480.0], (CAMERAS, 1))
    bundle = Bundle(
        BodyObservations(camera, body // each, offset, np.zeros((len(body), 2))), np.arange(CAMERAS), sizes,
        np.zeros(CAMERAS, bool), FREE, rotating,
        usual_prior(np.zeros(CAMERAS, np.intp), FREE, fisheye=False), noise=0.01,
    )  # fmt: skip
    truth = Parameters(np.stack(rotations), np.stack(translations), rows, body_rotations, body_positions)
    return replace(bundle, observations=replace(bundle.observations, pixels=bundle.residuals(truth))), truth


def shaken(truth: Parameters) -> Parameters:
    """Everything a little off."""
    rng = np.random.default_rng(1)
    turned = np.stack([rotation_matrix(w) for w in 0.01 * rng.normal(size=(len(truth.rotations), 3))])
    rows = truth.rows.copy()
    rows[:, FREE] = 0.0
    return replace(
        truth,
        rotations=turned @ truth.rotations,
        translations=truth.translations + 0.02 * rng.normal(size=truth.translations.shape),
        body_positions=truth.body_positions + 0.02 * rng.normal(size=truth.body_positions.shape),
        rows=rows,
    )


@pytest.mark.parametrize("rotating", [False, True], ids=["points", "boards"])
def test_cameras_and_lenses_are_found_again(rotating: bool) -> None:
    bundle, truth = parameters(rotating=rotating)
    found = solved(bundle, shaken(truth), max_steps=40)
    assert np.abs(bundle.residuals(found)).max() < 0.01
    np.testing.assert_allclose(found.rows, truth.rows, atol=2e-3)


@pytest.mark.parametrize("rotating", [False, True], ids=["points", "boards"])
def test_the_gradient_is_that_of_the_cost(rotating: bool) -> None:
    bundle, truth = parameters(rotating=rotating)
    start = shaken(truth)
    system = linearized(bundle, start)
    poses = bundle.columns[0]
    for lens, term in ((0, FOCAL), (2, DOWN), (4, K3)):
        step, costs = 1e-6, []
        for sign in (1, -1):
            rows = start.rows.copy()
            rows[lens, term] += sign * step
            costs.append(bundle.cost(replace(start, rows=rows)))
        expected = (costs[0] - costs[1]) / (2 * step)
        assert system.gradient[poses + lens * len(FREE) + FREE.index(term)] == pytest.approx(expected, rel=1e-4)


def test_one_wrong_observation_in_twenty_does_no_harm() -> None:
    bundle, truth = parameters(rotating=False)
    rng = np.random.default_rng(2)
    wrong = rng.random(len(bundle.observations.camera)) < 0.05
    pixels = bundle.observations.pixels + np.where(
        wrong[:, None], rng.uniform(-30, 30, bundle.observations.pixels.shape), 0.0
    )
    found = solved(replace(bundle, observations=replace(bundle.observations, pixels=pixels)), truth)
    assert np.median(np.abs(bundle.residuals(found)[~wrong])) < 0.02

# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment of points and boards, and the last one of a calibration with outliers."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from structgstream.cameras import Camera
from structgstream.data.calibration import rotation_matrix
from structgstream.data.lenses import LensCamera, RadialTangential
from structgstream.preparation.calibration.bundle import (
    BodyObservations,
    Bundle,
    Parameters,
    adjust_together,
    cleaned,
    linearized,
    solved,
)
from structgstream.preparation.calibration.lens_terms import (
    ACROSS,
    ASPECT,
    DISTORTION,
    DOWN,
    FOCAL,
    K1,
    K2,
    K3,
    TERMS,
    usual_prior,
)
from structgstream.preparation.calibration.solved import Observations, SolvedCalibration
from tests.support.calibration_errors import calibration_errors

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


PHONES, SEEN = 9, 300
BROWN = (FOCAL, ASPECT, ACROSS, DOWN, *DISTORTION["brown"])


def rig() -> tuple[SolvedCalibration, np.ndarray]:
    """Phones of one model on an arc, whose principal points lie 9 pixels aside; some observations are wrong."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (SEEN, 3))
    cameras = {}
    for index, angle in enumerate(np.linspace(-0.7, 0.7, PHONES)):
        viewmat = np.eye(4)
        viewmat[:3, :3] = rotation_matrix(np.array([0.25 * np.sin(3 * index), angle, 0.05 * np.cos(index)]))
        viewmat[:3, 3] = [0.1 * np.sin(index), 0.1 * np.cos(index), 3.4]
        focal = 600 * rng.uniform(0.98, 1.02)
        across, down = np.array([327, 246]) + rng.normal(0, 1.5, 2)
        K = torch.tensor([[focal, 0, across], [0, focal, down], [0, 0, 1]], dtype=torch.float64)
        lens = RadialTangential(k1=0.2, k2=-0.8, k3=0.8)
        cameras[f"cam{index}"] = LensCamera(Camera(torch.from_numpy(viewmat), K, 640, 480), lens)
    pixels = np.stack([filmed.pixels(points) for filmed in cameras.values()])
    shown = np.isfinite(pixels).all(2) & (pixels > 0).all(2) & (pixels < [640, 480]).all(2)
    camera, point = np.nonzero(shown & (shown.sum(0) > 1))
    noisy = pixels[camera, point] + rng.normal(0, 0.3, (len(camera), 2))
    wrong = rng.random(len(camera)) < 0.01
    noisy[wrong] += rng.uniform(10, 40, (int(wrong.sum()), 2))
    observations = Observations(point, camera, noisy, np.zeros(len(point), np.intp))
    return SolvedCalibration(cameras, points, observations), wrong


def guessed(truth: SolvedCalibration) -> SolvedCalibration:
    """The same with lenses of which only the focal length is known, roughly."""
    cameras = {}
    for name, filmed in truth.cameras.items():
        K = torch.tensor([[605.0, 0, 320], [0, 605.0, 240], [0, 0, 1]], dtype=torch.float64)
        cameras[name] = LensCamera(replace(filmed.camera, K=K), RadialTangential(k1=0.05))
    return replace(truth, cameras=cameras)


def test_lenses_of_phones_are_found_from_focal_lengths() -> None:
    truth, wrong = rig()
    found = adjust_together(guessed(truth), lens=range(PHONES), free=BROWN, pixels=2.0)
    errors = calibration_errors(found.cameras, truth.cameras).values()
    assert np.median([abs(error.focal_percent) for error in errors]) < 0.4
    assert np.median([error.lens_pixels for error in errors]) < 1.0
    lost = len(wrong) - len(found.observations)
    assert wrong.sum() <= lost < 1.5 * wrong.sum()


def test_shared_lenses_stay_so() -> None:
    truth, _ = rig()
    lens = [0, *[1] * (PHONES - 1)]
    found = adjust_together(guessed(truth), lens=lens, free=BROWN, pixels=20.0)
    first = found.cameras["cam1"]
    assert all(found.cameras[f"cam{number}"].lens == first.lens for number in range(1, PHONES))


def test_points_without_rays_apart_are_left_out() -> None:
    truth, _ = rig()
    far = truth.points.copy()
    far[0] = [0, 0, 1e4]
    seen = replace(truth.observations)
    pixels = seen.pixels.copy()
    for index, filmed in enumerate(truth.cameras.values()):
        own = (seen.camera == index) & (seen.point == 0)
        pixels[own] = filmed.pixels(far[:1])
    kept = cleaned(replace(truth, points=far, observations=replace(seen, pixels=pixels)), pixels=50.0)
    assert len(kept.points) == SEEN - 1 - int((np.bincount(seen.point, minlength=SEEN) == 0).sum())

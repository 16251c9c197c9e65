# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
import torch

from structgstream.cameras import Camera
from structgstream.data.lenses import Fisheye, Lens, LensCamera, Pinhole, RadialTangential
from structgstream.preparation.calibration.lens_terms import (
    ACROSS,
    FOCAL,
    TERMS,
    derivatives,
    projected,
    row_of,
    usual_prior,
    with_row,
)

LENSES: tuple[Lens, ...] = (
    Pinhole(),
    RadialTangential(0.2, -0.6, 0.001, -0.002, 0.5),
    RadialTangential(0.2, -0.3, 0.001, 0.0, 0.1, 0.05, -0.02, 0.01),
    Fisheye(-0.02, 0.003, 0.001, -0.0005),
)


def camera(lens: Lens) -> LensCamera:
    K = torch.tensor([[520.0, 0, 330], [0, 523, 236], [0, 0, 1]], dtype=torch.float64)
    return LensCamera(Camera(torch.eye(4, dtype=torch.float64), K, 640, 480), lens)


def points() -> np.ndarray:
    rng = np.random.default_rng(0)
    return np.concatenate([rng.uniform(-0.5, 0.5, (40, 2)), rng.uniform(1, 2, (40, 1))], 1)


@pytest.mark.parametrize("lens", LENSES, ids=["pinhole", "brown", "rational", "fisheye"])
def test_rows_project_as_cameras_do_and_come_back(lens: Lens) -> None:
    filmed, local = camera(lens), points()
    rows = np.tile(row_of(filmed), (len(local), 1))
    sizes, wide = np.tile([640.0, 480.0], (len(local), 1)), np.full(len(local), isinstance(lens, Fisheye))
    np.testing.assert_allclose(projected(local, rows, sizes, wide), filmed.pixels(local), atol=1e-8)
    again = with_row(filmed, row_of(filmed), np.eye(4))
    np.testing.assert_allclose(again.camera.K, filmed.camera.K)
    assert again.lens == lens


@pytest.mark.parametrize("lens", LENSES, ids=["pinhole", "brown", "rational", "fisheye"])
def test_derivatives_are_those_of_small_steps(lens: Lens) -> None:
    local, free = points(), (0, 1, 3, 4, 6)
    rows = np.tile(row_of(camera(lens)), (len(local), 1))
    sizes, wide = np.tile([640.0, 480.0], (len(local), 1)), np.full(len(local), isinstance(lens, Fisheye))
    by_point, by_row = derivatives(local, rows, sizes, wide, free)
    step = 1e-6
    for axis in range(3):
        ahead, behind = (projected(local + sign * step * np.eye(3)[axis], rows, sizes, wide) for sign in (1, -1))
        np.testing.assert_allclose(by_point[:, :, axis], (ahead - behind) / (2 * step), rtol=1e-4, atol=1e-3)
    for column, term in enumerate(free):
        ahead, behind = (projected(local, rows + sign * step * np.eye(TERMS)[term], sizes, wide) for sign in (1, -1))
        np.testing.assert_allclose(by_row[:, :, column], (ahead - behind) / (2 * step), rtol=1e-4, atol=1e-3)


def test_a_point_on_the_axis_of_a_fisheye_has_derivatives() -> None:
    by_point, by_row = derivatives(
        np.array([[0.0, 0.0, 1.0]]), np.zeros((1, TERMS)), np.array([[640.0, 480.0]]), np.array([True]), (0, 4)
    )
    assert np.isfinite(by_point).all()
    assert np.isfinite(by_row).all()


FREE = (FOCAL, ACROSS)
COUNT = 40


def lens_rows(mean: float, differences: float) -> np.ndarray:
    found = np.zeros((COUNT, TERMS))
    found[:, ACROSS] = mean + differences * np.random.default_rng(0).normal(size=COUNT)
    return found


def test_an_offset_that_all_share_costs_less_than_as_large_ones_of_their_own() -> None:
    prior = usual_prior(np.zeros(COUNT, np.intp), FREE, fisheye=False)
    alike, each = np.zeros((COUNT, TERMS)), np.zeros((COUNT, TERMS))
    alike[:, ACROSS] = 0.01
    each[:, ACROSS] = 0.01 * (-1.0) ** np.arange(COUNT)
    assert prior.cost(alike) < 0.01 * prior.cost(each)


def test_how_far_lenses_differ_is_estimated() -> None:
    prior = usual_prior(np.zeros(COUNT, np.intp), FREE, fisheye=False)
    for differences in (0.001, 0.02):
        found, own = prior, lens_rows(0.01, differences)
        for _ in range(20):
            found = found.updated(own, np.zeros((2 * COUNT, 2 * COUNT)), start=0, free=FREE)
        usual = 0.002  # and counts as two lenses
        expected = np.sqrt((2 * usual**2 + COUNT * differences**2) / (2 + COUNT))
        assert found.differences[0, 0] == pytest.approx(expected, rel=0.25)


def test_the_cost_has_the_gradient_and_the_curvature_that_are_added() -> None:
    prior = usual_prior(np.array([0, 0, 1, 1] * 10), FREE, fisheye=False)
    own, size = lens_rows(0.01, 0.004), 2 * COUNT
    A, gradient = np.zeros((size, size)), np.zeros(size)
    prior.add(A, gradient, own, start=0, free=FREE)
    step = np.zeros((COUNT, TERMS))
    step[:, ACROSS] = np.random.default_rng(1).normal(size=COUNT) * 1e-3
    flat = step[:, list(FREE)].ravel()
    assert prior.cost(own + step) - prior.cost(own) == pytest.approx(gradient @ flat + flat @ A @ flat / 2)

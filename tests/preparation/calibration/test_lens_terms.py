# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
import torch

from structgstream.cameras import Camera
from structgstream.data.lenses import Fisheye, Lens, LensCamera, Pinhole, RadialTangential
from structgstream.preparation.calibration.lens_terms import TERMS, derivatives, projected, row_of, with_row

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

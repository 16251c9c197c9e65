# SPDX-License-Identifier: Apache-2.0
import math

import cv2
import numpy as np
import pytest
import torch

from structgstream.cameras import Camera
from structgstream.data.lenses import (
    Fisheye,
    Lens,
    LensCamera,
    Pinhole,
    RadialTangential,
    fisheye_lens,
    from_integer_centers,
    opencv_lens,
)

K = np.array([[500.0, 0, 310], [0, 505, 250], [0, 0, 1]])
MILD = (-0.2, 0.05, 0.001, -0.002, 0.01, 0.02, 0.01, 0.001)
WIDE = (0.05, -0.01, 0.002, -0.001)
LENSES = [
    Pinhole(),
    RadialTangential(*MILD),
    RadialTangential(k1=-0.35),
    RadialTangential(k1=0.2, k2=0.05, p1=-0.003, p2=0.004),
    Fisheye(),
    Fisheye(*WIDE),
    Fisheye(k1=-0.3, k2=0.02),
]


def filmed(lens: Lens) -> LensCamera:
    """A camera whose intrinsics are those of an OpenCV calibration."""
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, 3] = torch.tensor([0.1, -0.2, 0.3], dtype=torch.float64)
    return LensCamera(Camera(viewmat, torch.from_numpy(from_integer_centers(K)), 640, 480), lens)


def grid(most: float, count: int = 21) -> np.ndarray:
    """Normalised points within a circle."""
    side = np.linspace(-most, most, count)
    points = np.stack(np.meshgrid(side, side), -1).reshape(-1, 2)
    return points[np.linalg.norm(points, axis=1) <= most]


@pytest.mark.parametrize("count", [0, 4, 5, 8, 14])
def test_what_opencv_projects(count: int) -> None:
    """Its pixels have their centres at integers, ours half a pixel on."""
    points = np.random.default_rng(0).uniform((-1, -1, 2), (1, 1, 4), (40, 3))
    coefficients = np.zeros(count)
    coefficients[: min(count, 8)] = MILD[: min(count, 8)]
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.array([0.1, -0.2, 0.3]), K, coefficients)
    np.testing.assert_allclose(
        filmed(opencv_lens(coefficients.tolist())).pixels(points), expected[:, 0] + 0.5, atol=1e-9
    )


def test_what_opencv_projects_through_a_fisheye() -> None:
    """Up to 150 degrees across."""
    points = np.concatenate([grid(math.tan(math.radians(75))), np.ones((317, 1))], axis=1)
    expected, _ = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.array([0.1, -0.2, 0.3]), K, np.array(WIDE))
    np.testing.assert_allclose(filmed(fisheye_lens(WIDE)).pixels(points), expected[:, 0] + 0.5, atol=1e-9)


@pytest.mark.parametrize("lens", LENSES)
def test_undistortion_is_the_inverse_wherever_the_lens_reaches(lens: Lens) -> None:
    points = grid(min(0.98 * lens.reach, math.tan(math.radians(80))))
    np.testing.assert_allclose(lens.undistort(lens.distort(points)), points, rtol=1e-6, atol=1e-7)
    camera = filmed(lens)
    pixels = camera.to_pixels(points)
    np.testing.assert_allclose(camera.to_normalized(pixels), points, rtol=1e-6, atol=1e-7)


def test_a_lens_that_folds_sees_nothing_beyond_the_fold() -> None:
    """1 + 3 k1 r^2 = 0 at r = 1 for k1 = -1/3; there the distorted radius is 2/3, and no other is farther."""
    lens = RadialTangential(k1=-1 / 3)
    assert lens.reach == pytest.approx(1)
    assert np.isfinite(lens.distort(np.array([0.99, 0.0]))).all()
    assert np.isnan(lens.distort(np.array([[1.01, 0.0], [0.8, 0.8]]))).all()
    assert np.isfinite(lens.undistort(np.array([0.66, 0.0]))).all()
    assert np.isnan(lens.undistort(np.array([0.67, 0.0]))).all()
    fisheye = Fisheye(k1=-1 / 3)
    assert fisheye.widest_angle == pytest.approx(1)
    assert fisheye.reach == pytest.approx(math.tan(1))
    assert np.isnan(fisheye.distort(np.array([math.tan(1.01), 0.0]))).all()
    pole = RadialTangential(k4=-0.25)
    assert pole.reach == pytest.approx(2)


def test_a_fisheye_is_equidistant() -> None:
    lens = Fisheye()
    for degrees in (1, 45, 75, 89):
        to_pixels = lens.distort(np.array([0.0, math.tan(math.radians(degrees))]))
        np.testing.assert_allclose(to_pixels, [0, math.radians(degrees)], atol=1e-9)
    assert np.isnan(lens.undistort(np.array([math.radians(91), 0.0]))).all()


def test_what_lies_behind_is_not_seen() -> None:
    assert np.isnan(filmed(Pinhole()).pixels(np.array([0.0, 0.0, -1.0]))).all()


def test_vectors_of_other_models_are_refused() -> None:
    with pytest.raises(ValueError, match="14 distortion coefficients; expected 4, 5 or 8"):
        opencv_lens([0.1] * 14)
    with pytest.raises(ValueError, match="3 distortion coefficients"):
        opencv_lens([0.1] * 3)
    with pytest.raises(ValueError, match="5 fisheye coefficients"):
        fisheye_lens([0.1] * 5)
    assert opencv_lens([0.0] * 5) == Pinhole()
    assert opencv_lens([1, 2, 3, 4, 5]) == RadialTangential(k1=1, k2=2, p1=3, p2=4, k3=5)
    assert fisheye_lens([1, 2]) == Fisheye(1, 2)


def random_lenses(count: int) -> list[Lens]:
    """Mild to impossible ones, with poles and folds."""
    generator = np.random.default_rng(0)
    found: list[Lens] = []
    for number in range(count):
        strength = (0.02, 0.2, 1.0, 5.0)[number // 2 % 4]
        if number % 2:
            share = np.array([1, 1, 0.05, 0.05, 1, *generator.integers(0, 2, 3)])
            found.append(RadialTangential(*(0.3 * strength * share * generator.normal(size=8)).tolist()))
        else:
            found.append(Fisheye(*(0.2 * strength * generator.normal(size=4)).tolist()))
    return found


def test_any_coefficients_are_inverted_up_to_where_they_fold() -> None:
    """Within a hundredth of the fold the inverse is ill-conditioned; nothing is raised, and nothing is warned of."""
    points = grid(2.0)
    for lens in random_lenses(24):
        to_pixels = lens.distort(points)
        inside = np.linalg.norm(points, axis=1) < 0.99 * lens.reach
        assert np.isfinite(to_pixels[inside]).all()
        back = lens.undistort(to_pixels)[inside]
        assert (np.abs(back - points[inside]) < 1e-4).all(1).mean() > 0.97, lens
        lens.undistort(points)


def test_a_coefficient_that_is_no_number_is_refused() -> None:
    for read in (opencv_lens, fisheye_lens):
        with pytest.raises(ValueError, match=r"not finite \(nan\)"):
            read([0.1, math.nan, 0.0, 0.0])

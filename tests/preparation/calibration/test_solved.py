# SPDX-License-Identifier: Apache-2.0
"""Errors of made observations; those in other coordinates are in ``test_coordinates``."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from structgstream.data.calibration import Alignment, rotation_matrix
from structgstream.data.lenses import Fisheye, LensCamera, RadialTangential
from structgstream.errors import CalibrationError
from structgstream.preparation.calibration.solved import Observations, SolvedCalibration
from tests.support.calibration_errors import calibration_errors, lens_difference
from tests.support.filmed import ring
from tests.support.views_made import cloud


def solved(rig: dict[str, LensCamera], points: np.ndarray, seen: list[tuple[int, int, tuple[float, float]]]):
    """With observations of a point by a camera, that many pixels to the right of and below where it is."""
    cameras = list(rig.values())
    pixels = np.array([np.nan_to_num(cameras[camera].pixels(points[point])) + off for point, camera, off in seen])
    point, camera = (np.array([entry[index] for entry in seen], np.intp) for index in range(2))
    return SolvedCalibration(rig, points, Observations(point, camera, pixels, np.zeros(len(seen), np.intp)))


def test_errors_follow_the_lens() -> None:
    rig = ring(2, radius=2.6, arc_degrees=40, lens=RadialTangential(k1=-0.12))
    found = solved(rig, cloud(3), [(0, 0, (3.0, -4.0)), (0, 1, (0.0, 0.0)), (2, 1, (0.0, 1.0))])
    np.testing.assert_allclose(found.residuals(), [[-3, 4], [0, 0], [0, -1]], atol=1e-9)
    np.testing.assert_allclose(found.errors(), [5, 0, 1], atol=1e-9)
    assert found.track_lengths().tolist() == [2, 0, 1]


def test_what_a_camera_cannot_see_has_no_error() -> None:
    """A point behind it."""
    rig = ring(2, radius=2.6, arc_degrees=40)
    behind = 3 * next(iter(rig.values())).camera.center.numpy()[None]
    found = solved(rig, behind, [(0, 0, (1.0, 1.0))])
    assert np.isnan(found.errors()).all()


RIG = ring(6, radius=2.0, arc_degrees=120)
MOVED = Alignment(3.0, rotation_matrix(np.array([0.1, 2.0, -0.3])), np.array([1.0, 2.0, 3.0]))


def changed(filmed: LensCamera, *, degrees: float = 0.0, focal: float = 1.0, center: float = 0.0) -> LensCamera:
    viewmat, K = filmed.camera.viewmat.clone(), filmed.camera.K.clone()
    viewmat[:3] = torch.from_numpy(rotation_matrix(np.array([0.0, np.radians(degrees), 0.0]))) @ viewmat[:3]
    K[[0, 1], [0, 1]] *= focal
    K[0, 2] += center
    return replace(filmed, camera=replace(filmed.camera, viewmat=viewmat, K=K))


def test_the_same_rig_elsewhere_and_larger_has_no_errors() -> None:
    for error in calibration_errors({name: MOVED.filmed(filmed) for name, filmed in RIG.items()}, RIG).values():
        assert (error.rotation_degrees, error.position_percent) == pytest.approx((0, 0), abs=1e-6)
        assert (error.focal_percent, error.lens_pixels) == pytest.approx((0, 0), abs=1e-6)


def test_a_turned_camera_is_reported_by_its_angle() -> None:
    """One of six: the rotation of the others is the rig's, by most of the angle."""
    turned = RIG | {"cam02": changed(RIG["cam02"], degrees=0.6)}
    errors = calibration_errors({name: MOVED.filmed(filmed) for name, filmed in turned.items()}, RIG)
    assert errors["cam02"].rotation_degrees == pytest.approx(0.5, abs=0.02)
    assert errors["cam05"].rotation_degrees == pytest.approx(0.1, abs=0.02)


def test_a_moved_camera_is_reported_in_percent_of_the_radius() -> None:
    viewmat = RIG["cam02"].camera.viewmat.clone()
    viewmat[0, 3] += 0.02 * 2.0
    moved = RIG | {"cam02": replace(RIG["cam02"], camera=replace(RIG["cam02"].camera, viewmat=viewmat))}
    error = calibration_errors(moved, RIG)["cam02"].position_percent
    centers = np.stack([filmed.camera.center.numpy() for filmed in RIG.values()])
    radius = np.linalg.norm(centers - centers.mean(0), axis=1).max()
    assert error == pytest.approx(100 * 0.04 / radius, rel=0.25)


def test_focal_lengths_are_reported_with_their_sign_and_in_pixels() -> None:
    wide, long = changed(RIG["cam02"], focal=0.98), changed(RIG["cam02"], focal=1.01)
    assert calibration_errors(RIG | {"cam02": wide}, RIG)["cam02"].focal_percent == pytest.approx(-2)
    assert calibration_errors(RIG | {"cam02": long}, RIG)["cam02"].focal_percent == pytest.approx(1)
    # A picture of 480 x 360: a point is 0.01 r off, and the root mean square of r is half the diagonal over sqrt(3).
    assert lens_difference(long, RIG["cam02"]) == pytest.approx(0.01 * 300 / np.sqrt(3), rel=0.05)


def test_a_principal_point_that_a_rotation_makes_up_for_hardly_counts() -> None:
    assert lens_difference(changed(RIG["cam02"], center=4.0), RIG["cam02"]) < 0.5


def test_distortion_that_is_not_estimated_counts() -> None:
    for lens in (RadialTangential(k1=-0.1), Fisheye()):
        assert lens_difference(RIG["cam02"], replace(RIG["cam02"], lens=lens)) > 2


def test_rigs_without_common_cameras_are_refused() -> None:
    with pytest.raises(CalibrationError, match="two cameras in common to be compared; they have cam01"):
        calibration_errors({"cam01": RIG["cam01"], "other": RIG["cam02"]}, RIG)

# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from structgstream.data.calibration import Alignment, rotation_matrix
from structgstream.data.lenses import RadialTangential
from structgstream.errors import CalibrationError
from structgstream.preparation.calibration.solved import (
    Observations,
    SolvedCalibration,
    normalized,
    with_distance,
)
from tests.support.filmed import ring

POINTS = np.random.default_rng(0).uniform(-0.4, 0.4, (12, 3))
TURN = Alignment(0.7, rotation_matrix(np.array([0.5, 1.0, -2.0])), np.array([4.0, 5.0, 6.0]))


def solved(*, off: float = 0.0) -> SolvedCalibration:
    """Three cameras that see all points; the last sees them ``off`` pixels to the right, and the first two of six."""
    rig = ring(3, radius=2.0, arc_degrees=60)
    seen = [filmed.pixels(POINTS) for filmed in rig.values()]
    seen[2] = seen[2] + (off, 0)
    point = np.concatenate([np.arange(6), np.arange(12), np.arange(12)])
    camera = np.repeat([0, 1, 2], [6, 12, 12])
    pixels = np.concatenate([seen[0][:6], seen[1], seen[2]])
    return SolvedCalibration(rig, POINTS, Observations(point, camera, pixels, np.zeros(30, np.intp)))


def test_errors_follow_the_lens() -> None:
    rig = ring(2, radius=2.6, arc_degrees=40, lens=RadialTangential(k1=-0.12))
    first, last = rig.values()
    pixels = [first.pixels(POINTS[:1])[0] + (3, -4), last.pixels(POINTS[:1])[0], last.pixels(POINTS[2:3])[0] + (0, 1)]
    seen = Observations(np.array([0, 0, 2]), np.array([0, 1, 1]), np.array(pixels), np.zeros(3, np.intp))
    found = SolvedCalibration(rig, POINTS[:3], seen)
    np.testing.assert_allclose(found.errors(), [5, 0, 1], atol=1e-9)
    assert found.track_lengths().tolist() == [2, 0, 1]


def test_what_a_camera_cannot_see_has_no_error() -> None:
    """A point behind it."""
    rig = ring(2, radius=2.6, arc_degrees=40)
    behind = 3 * next(iter(rig.values())).camera.center.numpy()[None]
    none = np.zeros(1, np.intp)
    found = SolvedCalibration(rig, behind, Observations(none, none, np.zeros((1, 2)), none))
    assert np.isnan(found.errors()).all()


def test_other_coordinates_change_no_error() -> None:
    for moved in (solved(off=0.5).aligned(TURN), normalized(solved(off=0.5))):
        np.testing.assert_allclose(moved.errors(), solved(off=0.5).errors(), atol=1e-9)


def test_normalised_is_about_the_cameras_and_in_the_axes_of_the_first() -> None:
    found = normalized(solved().aligned(TURN))
    centers = np.stack([filmed.camera.center.numpy() for filmed in found.cameras.values()])
    np.testing.assert_allclose(centers.mean(0), 0, atol=1e-9)
    assert np.linalg.norm(centers, axis=1).max() == pytest.approx(1)
    np.testing.assert_allclose(found.cameras["cam00"].camera.viewmat[:3, :3], np.eye(3), atol=1e-12)


def test_a_distance_gives_metres() -> None:
    found = with_distance(solved().aligned(TURN), "cam00", "cam02", metres=2.0)
    assert found.metres
    apart = found.cameras["cam00"].camera.center - found.cameras["cam02"].camera.center
    assert float(apart.norm()) == pytest.approx(2)
    with pytest.raises(CalibrationError, match="gives no scale"):
        with_distance(solved(), "cam00", "cam01", metres=-1.0)

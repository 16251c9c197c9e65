# SPDX-License-Identifier: Apache-2.0
"""Errors of made observations; those in other coordinates are in ``test_coordinates``."""

import numpy as np

from structgstream.data.lenses import LensCamera, RadialTangential
from structgstream.preparation.calibration.solved import Observations, SolvedCalibration
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
    np.testing.assert_allclose(found.errors(), [5, 0, 1], atol=1e-9)
    assert found.track_lengths().tolist() == [2, 0, 1]


def test_what_a_camera_cannot_see_has_no_error() -> None:
    """A point behind it."""
    rig = ring(2, radius=2.6, arc_degrees=40)
    behind = 3 * next(iter(rig.values())).camera.center.numpy()[None]
    found = solved(rig, behind, [(0, 0, (1.0, 1.0))])
    assert np.isnan(found.errors()).all()

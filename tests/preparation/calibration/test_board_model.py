# SPDX-License-Identifier: Apache-2.0
"""The model of a board whose poses, and so the pixels of its corners, are known."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from structgstream.data.lenses import LensCamera
from structgstream.preparation.calibration.board import Board, Sighting
from structgstream.preparation.calibration.board_solving import Sightings, board_model, rig_poses, sensor_poses
from structgstream.preparation.calibration.colmap import colmap_camera
from structgstream.preparation.calibration.mapping import Freedom, adjust
from tests.support.filmed import ring, turned

BOARD = Board(7, 5, 0.1)
RIG = ring(3, radius=1.4, arc_degrees=50)
SENSORS = {
    name: filmed.camera.viewmat.numpy() @ np.linalg.inv(RIG["cam00"].camera.viewmat.numpy())
    for name, filmed in RIG.items()
}


def board_to_world(instant: int) -> NDArray[np.float64]:
    pose = np.eye(4)
    pose[:3, :3] = turned(12.0 * instant - 25, axis=1) @ turned(9.0 * instant - 20, axis=0)
    pose[:3, 3] = (0.02 * instant - 0.4, 0.03 * instant - 0.3, 0.0)
    return pose


POSES = {
    instant: RIG["cam00"].camera.viewmat.numpy() @ board_to_world(instant) for instant in (0, 1, 3, 4)
}  # of the board in the first camera, which is the rig's


def sightings(*, noise: float = 0.0) -> Sightings:
    """All corners at all instants, but the last camera sees nothing of instant 1, and corner 5 is seen once."""
    generator = np.random.default_rng(0)

    def sight(name: str, filmed: LensCamera, instant: int) -> Sighting:
        corners = np.arange(24)
        if (name, instant) != ("cam00", 0):
            corners = np.delete(corners, 5)
        world = BOARD.corners[corners] @ board_to_world(instant)[:3, :3].T + board_to_world(instant)[:3, 3]
        return Sighting(instant, corners, filmed.pixels(world) + noise * generator.normal(size=(len(corners), 2)))

    return {
        name: tuple(sight(name, filmed, instant) for instant in POSES if (name, instant) != ("cam02", 1))
        for name, filmed in RIG.items()
    }


def cameras() -> dict[str, Any]:
    return {name: colmap_camera(filmed, number) for number, (name, filmed) in enumerate(RIG.items(), 1)}


def test_the_model_holds_poses_and_sightings() -> None:
    model = board_model(BOARD, sightings(), cameras(), SENSORS, POSES)
    for name, found in sensor_poses(model, cameras()).items():
        np.testing.assert_allclose(found, SENSORS[name], atol=1e-9)
    assert list(rig_poses(model)) == [0, 1, 3, 4]
    for instant, found in rig_poses(model).items():
        np.testing.assert_allclose(found, POSES[instant], atol=1e-9)
    assert len(model.point3D_ids()) == 23  # the corner that one picture shows is left out
    assert model.num_reg_images() == 11
    assert model.compute_num_observations() == 11 * 23
    model.update_point_3d_errors()
    assert model.compute_mean_reprojection_error() < 1e-6


def test_adjusting_shares_the_poses_of_still_cameras() -> None:
    """Cameras a little off and a board a little off come back in metres: the corners are fixed, all else is free."""
    off = np.eye(4)
    off[:3, :3], off[:3, 3] = turned(1.0, axis=1), (0.01, -0.02, 0.015)
    sensors = {name: pose if name == "cam00" else off @ pose for name, pose in SENSORS.items()}
    poses = {instant: off @ pose for instant, pose in POSES.items()}
    model = board_model(BOARD, sightings(noise=0.1), cameras(), sensors, poses)
    adjust(model, freedom=Freedom(False, False, False), constant_points=True)
    for name, found in sensor_poses(model, cameras()).items():
        np.testing.assert_allclose(found, SENSORS[name], atol=2e-3)
        assert (name == "cam00") == np.array_equal(found, np.eye(4))
    for instant, found in rig_poses(model).items():
        assert found[:3, 3] == pytest.approx(POSES[instant][:3, 3], abs=2e-3)

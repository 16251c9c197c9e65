# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
import torch

from structgstream.cameras import Camera
from structgstream.data.calibration import Alignment, alignment, rotation_matrix
from structgstream.data.matching import project
from tests.support.rigs import arc_rig

TURNED = Alignment(2.5, rotation_matrix(np.array([0.4, -1.2, 2.0])), np.array([3.0, -1.0, 0.5]))


def poses(cameras: dict[str, Camera]) -> dict[str, np.ndarray]:
    return {name: camera.viewmat.numpy() for name, camera in cameras.items()}


def test_a_similarity_is_found_from_the_cameras_that_it_moved() -> None:
    cameras = dict(arc_rig(5).cameras)
    moved = {name: TURNED.camera(camera) for name, camera in cameras.items()}
    found = alignment(poses(cameras), poses(moved))
    assert found.scale == pytest.approx(2.5)
    np.testing.assert_allclose(found.rotation, TURNED.rotation, atol=1e-12)
    np.testing.assert_allclose(found.translation, TURNED.translation, atol=1e-12)


def test_an_aligned_camera_sees_aligned_points_where_it_saw_them() -> None:
    camera = arc_rig(3)["cam01"]
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (20, 3))
    before, depths = project(camera, points)
    after, scaled = project(TURNED.camera(camera), TURNED.points(points))
    np.testing.assert_allclose(after, before, atol=1e-9)
    np.testing.assert_allclose(scaled, 2.5 * depths)
    assert TURNED.camera(camera).near == pytest.approx(2.5 * camera.near)


def test_cameras_in_a_line_give_the_rotation_about_it_too() -> None:
    line = {}
    for index in range(4):
        viewmat = torch.eye(4, dtype=torch.float64)
        viewmat[0, 3] = -float(index)
        line[f"cam{index}"] = replace(arc_rig(3)["cam00"], viewmat=viewmat)
    moved = {name: TURNED.camera(camera) for name, camera in line.items()}
    np.testing.assert_allclose(alignment(poses(line), poses(moved)).rotation, TURNED.rotation, atol=1e-12)


def test_cameras_at_one_place_keep_their_scale() -> None:
    one = poses({"a": arc_rig(3)["cam00"]})
    assert alignment(one, one).scale == 1.0

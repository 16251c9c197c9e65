# SPDX-License-Identifier: Apache-2.0
"""Rotations, poses and intrinsics of calibration files."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from structgstream.cameras import Camera
from structgstream.data.calibration import (
    Alignment,
    PosedCamera,
    alignment,
    calibrated_camera,
    calibrated_rig,
    listed,
    rigid,
    rotation_matrix,
)
from structgstream.data.matching import project
from structgstream.errors import CalibrationError
from tests.support.properties import examples
from tests.support.rigs import arc_rig

WHERE = Path("take/cameras.json")
K = np.array([[40.0, 0, 32], [0, 40, 24], [0, 0, 1]])


def camera(viewmat: object = np.eye(4), intrinsics: object = K, *, size: tuple[int, int] = (64, 48)) -> Camera:
    return calibrated_camera("c7", viewmat=viewmat, K=intrinsics, size=size, where=WHERE)  # type: ignore[arg-type]


def test_three_rows_of_a_pose_are_enough() -> None:
    assert camera(np.eye(4)[:3]).viewmat.tolist() == np.eye(4).tolist()


@pytest.mark.parametrize(
    ("viewmat", "intrinsics", "words"),
    [
        (np.full((4, 4), np.nan), K, "not finite"),
        (np.eye(4), K * [[np.nan], [1], [1]], "not finite"),
        (np.eye(4) * 2, K, "orthonormal"),
        (np.diag([1, 1, -1, 1]), K, "orthonormal"),
        ([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0.1, 0.2, 3, 1]], K, "last row .* transpose"),
        (np.diag([1, 1, 1, 2]), K, "last row"),
        (np.eye(4), K.T, "last row of the K .* transpose"),
        (np.eye(3), K, "4x4"),
        ([[1, 2], [3]], K, "cannot be read"),
        ("what", K, "cannot be read"),
        (np.eye(4), K * [[-1], [1], [1]], "positive"),
    ],
)
def test_broken_numbers_name_the_camera_and_the_file(viewmat: object, intrinsics: object, words: str) -> None:
    with pytest.raises(CalibrationError, match=f"'c7' of {WHERE}.*{words}"):
        camera(viewmat, intrinsics)


@pytest.mark.parametrize(("width", "height"), [(32, 24), (640, 480), (128, 96)])
def test_intrinsics_of_another_picture_size_are_refused(width: int, height: int) -> None:
    with pytest.raises(CalibrationError, match=f"does not belong to a picture of {width}x{height}"):
        camera(size=(width, height))


def test_a_principal_point_off_centre_is_accepted() -> None:
    assert camera(intrinsics=K + np.array([[0, 0, 14], [0, 0, -2], [0, 0, 0]])).K[0, 2] == 46


@pytest.mark.parametrize(
    ("moved", "words"),
    [((0, 0), "'a' and 'b' have the same pose"), ((0, 0.1), "All 2 cameras stand at one place")],
)
def test_cameras_without_poses_of_their_own_are_refused(moved: tuple[float, float], words: str) -> None:
    """Tools write zeros for what they did not calibrate."""
    rig = {name: camera(rigid([0, angle, 0], [0, 0, 0]), K) for name, angle in zip("ab", moved, strict=True)}
    with pytest.raises(CalibrationError, match=f"{WHERE}: .*{words}"):
        calibrated_rig(rig, (), where=WHERE)


def test_long_lists_are_cut() -> None:
    assert listed("abcdefg", limit=3) == "cameras 'a', 'b', 'c' and 4 more"


VECTOR = st.tuples(*[st.floats(-4.0, 4.0)] * 3)


@given(VECTOR)
@examples(200)
def test_a_rotation_vector_is_as_opencv_reads_it(vector: tuple[float, float, float]) -> None:
    found = rotation_matrix(np.array(vector))
    np.testing.assert_allclose(found, cv2.Rodrigues(np.array(vector))[0], atol=1e-9)
    np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(found) == pytest.approx(1.0)


@given(VECTOR, VECTOR)
@examples(100)
def test_a_pose_takes_a_vector_or_a_matrix(vector: tuple[float, ...], moved: tuple[float, ...]) -> None:
    turn = rotation_matrix(np.array(vector))
    one, other = rigid(vector, moved), rigid(turn, np.array(moved)[:, None])
    np.testing.assert_array_equal(one, other)
    np.testing.assert_allclose(one @ [*moved, 1.0], [*(turn @ moved + np.array(moved)), 1.0], atol=1e-12)
    camera = PosedCamera("a", one, np.eye(3), None)
    np.testing.assert_allclose(one @ [*camera.center, 1.0], [0, 0, 0, 1], atol=1e-9)


@pytest.mark.parametrize(
    ("turn", "move"), [(np.eye(2), [0, 0, 0]), ([0, 0], [0, 0, 0]), (np.eye(3), [0, 0]), (1.0, [0])]
)
def test_other_shapes_are_no_pose(turn: object, move: object) -> None:
    with pytest.raises(ValueError, match="a rotation of shape"):
        rigid(turn, move)  # type: ignore[arg-type]


def test_angles_in_degrees_are_no_rotation_vector() -> None:
    with pytest.raises(ValueError, match="a rotation vector of length 95.5.*more than a turn in radians"):
        rigid([10.0, -95.0, 0.0], [0, 0, 3])
    assert np.isfinite(rigid([2 * np.pi, 0, 0], [0, 0, 3])).all()


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

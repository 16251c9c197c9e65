# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import numpy as np
import pytest

from structgstream.cameras import Camera, rig_radius
from structgstream.data.calibration import calibrated_camera, calibrated_rig, check_names, listed
from structgstream.errors import CalibrationError, CaptureError
from tests.support.captures import small_rig

WHERE = Path("take/cameras.json")
K = np.array([[40.0, 0, 32], [0, 40, 24], [0, 0, 1]])


def camera(viewmat: object = np.eye(4), intrinsics: object = K, *, width: int = 64, height: int = 48) -> Camera:
    return calibrated_camera("c7", viewmat=viewmat, K=intrinsics, width=width, height=height, where=WHERE)  # type: ignore[arg-type]


def test_three_rows_of_a_pose_are_enough() -> None:
    assert camera(np.eye(4)[:3]).viewmat.tolist() == np.eye(4).tolist()


@pytest.mark.parametrize(
    ("viewmat", "intrinsics", "words"),
    [
        (np.full((4, 4), np.nan), K, "not finite"),
        (np.eye(4), K * [[np.nan], [1], [1]], "not finite"),
        (np.eye(4) * 2, K, "orthonormal"),
        (np.diag([1, 1, -1, 1]), K, "orthonormal"),
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
        camera(width=width, height=height)


def test_a_principal_point_off_centre_is_accepted() -> None:
    assert camera(intrinsics=K + np.array([[0, 0, 14], [0, 0, -2], [0, 0, 0]])).K[0, 2] == 46


def test_near_defaults_to_a_share_of_the_rig() -> None:
    rig = small_rig()
    found = calibrated_rig(rig.cameras, rig.held_out, where=WHERE)
    assert found["cam01"].near == pytest.approx(0.12 * rig_radius(rig))
    assert calibrated_rig(rig.cameras, rig.held_out, where=WHERE, near=0.5)["cam00"].near == 0.5


def test_fewer_than_two_training_cameras_are_refused() -> None:
    cameras = dict(list(small_rig().cameras.items())[:2])
    with pytest.raises(CalibrationError, match=f"{WHERE}: .*at least two training cameras, got 1"):
        calibrated_rig(cameras, ["cam00"], where=WHERE)


def test_pictures_and_calibration_must_be_of_the_same_cameras() -> None:
    folder = Path("take")
    check_names(["a", "b"], ["b", "a"], calibration=WHERE, pictures=folder)
    with pytest.raises(CalibrationError, match=r"pictures of camera 'c', for which .* no calibration"):
        check_names(["a", "b"], ["a", "b", "c"], calibration=WHERE, pictures=folder)
    with pytest.raises(CaptureError, match="calibrates cameras 'a', 'c', but take has no pictures"):
        check_names(["a", "b", "c"], ["b"], calibration=WHERE, pictures=folder)


def test_long_lists_are_cut() -> None:
    assert listed("abcdefg", limit=3) == "cameras 'a', 'b', 'c' and 4 more"

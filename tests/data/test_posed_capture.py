# SPDX-License-Identifier: Apache-2.0
"""Cameras of a calibration for pictures of some names and sizes; whole captures are opened in ``test_colmap_capture``,
``test_calibrated_capture`` and ``test_found_calibrations``."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from structgstream.data.calibration import Calibration, PosedCamera
from structgstream.data.lenses import RadialTangential
from structgstream.data.posed_capture import filmed_by, open_posed
from structgstream.errors import CalibrationError
from tests.support.captures import HEIGHT, WIDTH, small_rig, write_pictures

LENS = RadialTangential(k1=-0.1)
ROOT = Path("take")


def calibration(names: Sequence[str], *, size: tuple[int, int] | None = (WIDTH, HEIGHT)) -> Calibration:
    """Cameras of an arc; those of the names beyond them stand where the first does."""
    rig = list(small_rig(max(len(names), 3)).cameras.values())
    cameras = [
        PosedCamera(name, own.viewmat.numpy().copy(), own.K.numpy(), size, LENS)
        for name, own in zip(names, rig, strict=False)
    ]
    return Calibration(Path("rig.json"), tuple(cameras))


def owners(found: dict, given: Calibration) -> dict[str, str]:
    """The calibrated camera of each file, by its pose."""
    poses = {camera.name: camera.viewmat for camera in given.cameras}
    return {
        name: next(own for own, pose in poses.items() if np.allclose(pose, camera.camera.viewmat))
        for name, camera in found.items()
    }


@pytest.mark.parametrize(
    ("names", "files"),
    [
        (("left", "middle", "right"), ("left", "middle", "right")),
        (("left", "middle", "right"), ("take2_left", "middle-0007", "right.raw")),
        (("cam_1", "cam_2", "cam_10"), ("Camera01", "Camera02", "Camera10")),
        (("images/left/0001.png", "images/middle/0001.png", "images/right/0001.png"), ("left", "middle", "right")),
        (("left.png", "middle.png", "right.png"), ("left", "middle", "right")),
        (  # serial numbers, of one camera more, in what cameras write
            ("23088", "26580", "23087", "1"),
            ("take 2_Miqus_7_23088", "take 2_Miqus_8_26580", "take 2_Miqus_9_23087"),
        ),
    ],
)
def test_names_are_matched(names: tuple[str, ...], files: tuple[str, ...]) -> None:
    given = calibration(names)
    found = filmed_by(given, dict.fromkeys(reversed(files), (WIDTH, HEIGHT)), root=ROOT)
    assert owners(found, given) == dict(zip(files, names))
    assert list(found) == list(reversed(files))  # the order of the pictures
    assert {camera.lens for camera in found.values()} == {LENS}


@pytest.mark.parametrize(
    ("names", "files"),
    [
        (("left", "middle", "right"), ("one", "two", "three")),
        (("cam1", "cam2", "cam3"), ("a1", "a2", "a4")),  # other numbers
        (("cam1", "cam2"), ("a1", "b1", "a2")),  # one number twice
        (("left", "right", "up"), ("left_right", "right_1", "up_1")),  # one has two of the words
        (("left/0.png", "right/0.png", "up/0.png"), ("left_x", "right_x", "up_x")),  # folders have whole names
    ],
)
def test_names_that_do_not_fit_are_not_guessed(names: tuple[str, ...], files: tuple[str, ...]) -> None:
    with pytest.raises(CalibrationError, match="belongs to the pictures in take: the one names"):
        filmed_by(calibration(names), dict.fromkeys(files, (WIDTH, HEIGHT)), root=ROOT)


def test_a_camera_without_calibration_is_named() -> None:
    sizes: dict[str, tuple[int, int]] = dict.fromkeys(("cam0", "cam1", "cam2", "extra"), (WIDTH, HEIGHT))
    with pytest.raises(CalibrationError, match=r"pictures of camera 'extra', for which rig\.json has no calibration"):
        filmed_by(calibration(("cam0", "cam1", "cam2")), sizes, root=ROOT)


@pytest.mark.parametrize("factor", [0.5, 2])
def test_intrinsics_follow_the_size_of_the_pictures(factor: float) -> None:
    given = calibration(("cam0", "cam1", "cam2"))
    size = round(WIDTH * factor), round(HEIGHT * factor)
    for name, camera in filmed_by(given, {own.name: size for own in given.cameras}, root=ROOT).items():
        own = next(own for own in given.cameras if own.name == name)
        np.testing.assert_allclose(camera.camera.K[:2], factor * own.K[:2])
        assert (camera.camera.width, camera.camera.height) == size


def test_a_calibration_without_sizes_is_of_the_pictures() -> None:
    given = calibration(("cam0", "cam1", "cam2"), size=None)
    found = filmed_by(given, {own.name: (99, 33) for own in given.cameras}, root=ROOT)
    np.testing.assert_allclose(found["cam1"].camera.K, given.cameras[1].K)


@pytest.mark.parametrize(("factor", "warns"), [(1, False), (0.75, True), (1.5, True)])
def test_principal_points_tell_the_size_that_is_not_stated(
    factor: float, warns: bool, caplog: pytest.LogCaptureFixture
) -> None:
    """Within what is refused for one camera, whose picture may be a crop."""
    given = calibration(("cam0", "cam1", "cam2"), size=None)
    size = round(WIDTH * factor), round(HEIGHT * factor)
    filmed_by(given, {own.name: size for own in given.cameras}, root=ROOT)
    assert ("states no size of pictures, and its principal points lie at" in caplog.text) is warns


@pytest.mark.parametrize(("width", "warns"), [(400, False), (408, True), (800, False)])
def test_pictures_of_nearly_the_size_may_be_distorted(
    width: int, warns: bool, caplog: pytest.LogCaptureFixture
) -> None:
    given = calibration(("cam0", "cam1", "cam2"), size=(400, 300))
    given = replace(given, cameras=tuple(replace(own, K=own.K * [[6.25], [6.25], [1]]) for own in given.cameras))
    filmed_by(given, {own.name: (width, width * 3 // 4) for own in given.cameras}, root=ROOT)
    assert ("is for pictures of 400x300 pixels, those of camera 'cam0' have 408x306" in caplog.text) is warns


def test_a_crop_is_no_reduction() -> None:
    given = calibration(("cam0", "cam1", "cam2"))
    sizes = {own.name: (WIDTH, HEIGHT) for own in given.cameras} | {"cam1": (WIDTH, HEIGHT - 6)}
    with pytest.raises(CalibrationError, match="'cam1' have 64x42 pixels, .*other proportions"):
        filmed_by(given, sizes, root=ROOT)
    rounded = sizes | {"cam1": (WIDTH // 2, HEIGHT // 2 + 1)}  # a tool that rounds up
    assert filmed_by(given, rounded, root=ROOT)["cam1"].camera.height == HEIGHT // 2 + 1


@pytest.mark.parametrize(("share", "moves"), [(0.005, False), (0.03, True)])
def test_poses_of_one_camera_must_agree(share: float, moves: bool) -> None:
    """Two pictures of one camera; the second is estimated a share of the rig's extent away."""
    given = calibration(("a/1.png", "b/1.png", "c/1.png"))
    centers = np.array([camera.center for camera in given.cameras])
    again = given.cameras[0].viewmat.copy()
    again[:3, 3] += again[:3, :3] @ [share * np.linalg.norm(np.ptp(centers, axis=0)), 0, 0]
    given = replace(given, cameras=(*given.cameras, replace(given.cameras[0], name="a/2.png", viewmat=again)))
    sizes = dict.fromkeys("abc", (WIDTH, HEIGHT))
    if moves:
        with pytest.raises(CalibrationError, match=r"'a' moves in rig\.json: 'a/1\.png' and 'a/2\.png'"):
            filmed_by(given, sizes, root=ROOT)
    else:
        assert owners(filmed_by(given, sizes, root=ROOT), given)["a"] == "a/1.png"  # the first one's pose


def test_rounded_rotations_stand_still() -> None:
    """With four decimals the trace of R R^T is off by enough for half a degree, if one asks its arc cosine."""
    for seed in range(20):
        turn = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
        turn *= np.sign(np.linalg.det(turn))
        given = calibration(["left", "middle", "right"])
        for camera in given.cameras:
            camera.viewmat[:3, :3] = (camera.viewmat[:3, :3] @ turn).round(4)
        found = filmed_by(given, dict.fromkeys(("left", "middle"), (WIDTH, HEIGHT)), root=ROOT)
        assert list(found) == ["left", "middle"]


def test_cameras_are_held_out_by_their_name_in_the_calibration(tmp_path: Path) -> None:
    write_pictures(tmp_path, "images/CAM/FRAME.png", ("left", "middle", "right"), frames=1)
    names = tuple(f"images/{name}/000000.png" for name in ("left", "middle", "right"))
    given = replace(calibration(names), held_out=names[1:2])
    assert open_posed(tmp_path, given, fps=25.0).rig.testing == ("middle",)

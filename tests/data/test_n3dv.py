# SPDX-License-Identifier: Apache-2.0
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from structgstream.data import dataset_layouts as clip
from structgstream.data.dataset_layouts import bundled_clip, open_n3dv
from structgstream.errors import CalibrationError
from tests.support.captures import (
    all_numbers,
    picture,
    small_rig,
    write_meet_room,
    write_n3dv,
    write_picture,
    write_pictures,
    write_text_model,
)

CLIP_FOLDER = Path(clip.__file__).parent / "clip"


def test_poses_become_opencv_world_to_camera(tmp_path: Path) -> None:
    """Rows belong to the existing videos in sorted order; camera 2 is not there."""
    rig = write_n3dv(tmp_path)
    source = open_n3dv(tmp_path)
    assert list(source.rig) == ["cam00", "cam01", "cam03", "cam04"]
    assert (source.rig.testing, source.fps, len(source)) == (("cam00",), 30.0, 6)
    for name in rig:
        torch.testing.assert_close(source.rig[name].viewmat, rig[name].viewmat)
        torch.testing.assert_close(source.rig[name].K, rig[name].K)
    assert all_numbers(source.frames(5)) == [[(camera, 5) for camera in range(4)]]


@pytest.mark.parametrize("size", [2.0, 0.5])
def test_reduced_videos_scale_the_intrinsics(tmp_path: Path, size: float) -> None:
    rig = write_n3dv(tmp_path, size=size)
    source = open_n3dv(tmp_path)
    camera = source.rig["cam01"]
    assert (camera.width, camera.height) == (64, 48)
    torch.testing.assert_close(camera.K, rig["cam01"].K)


def test_meet_room_holds_its_first_camera_out(tmp_path: Path) -> None:
    """Thirteen videos, cam_0 to cam_12: the poses follow the numbers, not the alphabet."""
    rig = write_meet_room(tmp_path)
    source = open_n3dv(tmp_path)
    assert list(source.rig) == [f"cam_{number}" for number in range(13)]
    assert source.rig.testing == ("cam_0",)
    for name in rig:
        torch.testing.assert_close(source.rig[name].viewmat, rig[name].viewmat)
    assert all_numbers(source.frames(5)) == [[(camera, 5) for camera in range(13)]]


POINTS = np.array([[0.1, 0.2, 0.3], [-0.5, 0.25, 1.0]])


@pytest.mark.parametrize(
    ("folder", "pattern"),
    [("sparse/0", "{}.png"), ("colmap/sparse/0", "{}"), ("colmap_0/sparse/0", "{}/000017.png"),
     ("sparse/0", "images/{}/1.jpg")],
)  # fmt: skip
def test_points_of_a_model_with_the_same_poses(tmp_path: Path, folder: str, pattern: str) -> None:
    """Three cameras of the rig by name are enough; several pictures of one and other cameras are no obstacle."""
    rig = write_n3dv(tmp_path)
    names = list(rig)[1:]
    images = [*[(pattern.format(name), name) for name in names] * 2, ("stranger.png", names[0])]
    write_text_model(tmp_path / folder, rig, images, points=POINTS)
    np.testing.assert_allclose(open_n3dv(tmp_path).points, POINTS, atol=1e-6)  # type: ignore[arg-type]


def test_points_of_a_model_with_a_frame_of_its_own(tmp_path: Path) -> None:
    """What COLMAP makes from scratch: turned, moved, scaled."""
    rig = write_n3dv(tmp_path)
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    change_of_frame = torch.eye(4, dtype=torch.float64)
    change_of_frame[:3, :3] = torch.from_numpy(turn)
    cameras = {}
    for name, camera in rig.cameras.items():
        viewmat = camera.viewmat @ change_of_frame.inverse()
        viewmat[:3, 3] = 2.5 * viewmat[:3, 3] - viewmat[:3, :3] @ torch.tensor([3.0, 4.0, 5.0], dtype=torch.float64)
        cameras[name] = replace(camera, viewmat=viewmat)
    theirs = 2.5 * POINTS @ turn.T + [3, 4, 5]
    write_text_model(tmp_path / "sparse/0", rig.mapped(cameras), [(f"{n}.png", n) for n in rig], points=theirs)
    np.testing.assert_allclose(open_n3dv(tmp_path).points, POINTS, atol=1e-6)  # type: ignore[arg-type]


def test_points_of_another_rig_are_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    rig = write_n3dv(tmp_path)
    names = list(rig)
    swapped = [(f"{names[1]}.png", names[2]), (f"{names[2]}.png", names[1]), *[(f"{n}.png", n) for n in names[3:]]]
    write_text_model(tmp_path / "sparse/0", rig, [*swapped, ("cam00.png", names[0])], points=POINTS)
    assert open_n3dv(tmp_path).points is None
    assert "their extent away from the rig's; its points are not used" in caplog.text
    caplog.clear()
    other = small_rig(4)
    few = [(f"{names[0]}.png", "cam00"), (f"{names[1]}.png", "cam01"), ("stranger.png", "cam02")]
    write_text_model(tmp_path / "sparse/0", other, few, points=POINTS)
    assert open_n3dv(tmp_path).points is None
    assert "has 2 cameras of the rig by name; its points are not used" in caplog.text


def change(path: Path, rows: slice, column: int, value: float) -> None:
    poses = np.load(path / "poses_bounds.npy")
    poses[rows, column] = value
    np.save(path / "poses_bounds.npy", poses)


def test_one_pose_per_video(tmp_path: Path) -> None:
    write_n3dv(tmp_path)
    (tmp_path / "cam03.mp4").unlink()
    with pytest.raises(CalibrationError, match=r"4 poses, .* 3 videos"):
        open_n3dv(tmp_path)


@pytest.mark.parametrize(("column", "value", "words"), [(3, np.nan, "not finite"), (0, 3.0, "orthonormal")])
def test_numbers_that_cannot_be_name_the_camera(tmp_path: Path, column: int, value: float, words: str) -> None:
    write_n3dv(tmp_path)
    change(tmp_path, slice(2, 3), column, value)
    with pytest.raises(CalibrationError, match=rf"'cam03' of .*poses_bounds\.npy.*{words}"):
        open_n3dv(tmp_path)


@pytest.mark.parametrize("content", [b"", b"junk", None])
def test_a_file_that_is_something_else(tmp_path: Path, content: bytes | None) -> None:
    write_n3dv(tmp_path)
    if content is None:
        np.save(tmp_path / "poses_bounds.npy", np.zeros((4, 3)))
    else:
        (tmp_path / "poses_bounds.npy").write_bytes(content)
    with pytest.raises(CalibrationError, match=r"poses_bounds\.npy (cannot be read|has shape \(4, 3\))"):
        open_n3dv(tmp_path)


@pytest.mark.parametrize("as_text", [True, False])
def test_the_pictures_tell_the_order_of_rows(tmp_path: Path, as_text: bool) -> None:
    """LLFF sorts cam1, cam10, cam2 as text; others by number."""
    whole = bundled_clip().rig
    names = {f"cam{number}": name for number, name in enumerate(whole, start=1)}
    for name, theirs in names.items():
        shutil.copy(CLIP_FOLDER / f"{theirs}.mp4", tmp_path / f"{name}.mp4")
    rows = []
    for name in sorted(names) if as_text else names:
        camera = whole[names[name]]
        pose = camera.viewmat.inverse().numpy()
        hwf = np.array([camera.height, camera.width, float(camera.K[0, 0])])
        columns = [pose[:3, 1], pose[:3, 0], -pose[:3, 2], pose[:3, 3], hwf]
        rows.append(np.concatenate([np.stack(columns, axis=1).ravel(), [0.5, 9.0]]))
    np.save(tmp_path / "poses_bounds.npy", np.array(rows))
    source = open_n3dv(tmp_path)
    assert list(source.rig) == list(names)
    for name, theirs in names.items():
        torch.testing.assert_close(source.rig[name].viewmat, whole[theirs].viewmat)


def test_decoded_pictures(tmp_path: Path) -> None:
    """4DGaussians leaves camXX/images/FRAME.png."""
    rig = write_n3dv(tmp_path)
    for file in tmp_path.glob("*.mp4"):
        file.unlink()
    write_pictures(tmp_path, "CAM/images/FRAME.png", rig, frames=2)
    source = open_n3dv(tmp_path)
    assert (source.rig.testing, len(source)) == (("cam00",), 2)
    assert all_numbers(source.frames(1)) == [[(camera, 1) for camera in range(4)]]


def test_one_picture_a_camera(tmp_path: Path) -> None:
    """As LLFF and mip-NeRF 360 are published, with reduced copies."""
    rig = write_n3dv(tmp_path)
    for file in tmp_path.glob("*.mp4"):
        file.unlink()
    for folder in ("images", "images_4"):
        write_pictures(tmp_path / folder, "CAM.JPG", rig, frames=1)
    source = open_n3dv(tmp_path)
    assert all_numbers(source.frames()) == [[(camera, 0) for camera in range(4)]]
    torch.testing.assert_close(source.rig["cam03"].viewmat, rig["cam03"].viewmat)


def test_pictures_of_the_held_out_camera_alone(tmp_path: Path) -> None:
    np.save(tmp_path / "poses_bounds.npy", np.array([[0, 1, 0, 0, 48, 1, 0, 0, 0, 64, 0, 0, -1, 0, 60, 1, 10]], float))
    write_picture(tmp_path / "cam00/images/0000.png", picture(0, 0))
    with pytest.raises(CalibrationError, match=r"at least two training cameras, got 0 \(1 in the capture, 1 held out"):
        open_n3dv(tmp_path)

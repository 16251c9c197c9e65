# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import numpy as np
import pytest
import torch

from captures import all_numbers, write_n3dv
from structgstream.data.n3dv import open_n3dv
from structgstream.errors import CalibrationError


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


def change(path: Path, rows: slice, column: int, value: float) -> None:
    poses = np.load(path / "poses_bounds.npy")
    poses[rows, column] = value
    np.save(path / "poses_bounds.npy", poses)


def test_other_proportions_are_refused(tmp_path: Path) -> None:
    write_n3dv(tmp_path)
    change(tmp_path, slice(None), 4, 60)  # the height
    with pytest.raises(CalibrationError, match=r"cam00\.mp4 has 64x48 pixels, .* is for 64x60"):
        open_n3dv(tmp_path)


def test_one_pose_per_video(tmp_path: Path) -> None:
    write_n3dv(tmp_path)
    (tmp_path / "cam03.mp4").unlink()
    with pytest.raises(CalibrationError, match=r"4 poses, .* 3 mp4 files"):
        open_n3dv(tmp_path)


@pytest.mark.parametrize("column", [3, 4, 6, 14])
def test_nan_names_the_camera(tmp_path: Path, column: int) -> None:
    write_n3dv(tmp_path)
    change(tmp_path, slice(2, 3), column, np.nan)
    with pytest.raises(CalibrationError, match=r"'cam03' of .*poses_bounds\.npy .*not finite"):
        open_n3dv(tmp_path)


def test_a_pose_that_is_no_rotation_names_the_camera(tmp_path: Path) -> None:
    write_n3dv(tmp_path)
    change(tmp_path, slice(1, 2), 0, 3.0)
    with pytest.raises(CalibrationError, match=r"'cam01' of .*orthonormal"):
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

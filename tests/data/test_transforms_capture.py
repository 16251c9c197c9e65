# SPDX-License-Identifier: Apache-2.0
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from structgstream.data import transforms
from structgstream.data.lenses import RadialTangential
from structgstream.data.open import open_capture
from structgstream.data.transforms import open_transforms
from structgstream.errors import CalibrationError, CaptureError
from tests.support.calibrations import truths, write_transforms
from tests.support.captures import HEIGHT, WIDTH, all_numbers, edit_json, picture, write_picture, write_videos

CAMERAS = truths(dist=())
FRAMES = 3


def write(path: Path, pattern: str, *, name: str = "transforms.json", cameras: range = range(3), **top: object) -> None:
    """Pictures and a file that lists all of them with times; Blender's has an angle and no size."""
    frames = []
    for number in cameras:
        for frame in range(FRAMES):
            file = pattern.replace("CAM", f"cam{number:02d}").replace("FRAME", f"{frame:04d}")
            write_picture(path / file, picture(number, frame))
            entry = {"file_path": file, "transform_matrix": CAMERAS[number].opengl_pose, "time": frame / FRAMES}
            frames.append(entry)
    angle = 2 * math.atan(WIDTH / 2 / 40)
    (path / name).write_text(json.dumps({"camera_angle_x": angle, **top, "frames": frames}))


def edit_frames(file: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Changes the entry of each picture."""
    edit_json(file, lambda content: [change(entry) for entry in content["frames"]])


@pytest.mark.parametrize("pattern", ["rgb/CAM/FRAME.png", "FRAME/CAM.png", "images/CAM_FRAME.png", "all/FRAME_CAM.jpg"])
def test_pictures_with_times(tmp_path: Path, pattern: str) -> None:
    """Pictures of one pose are of one camera, whatever the folders; the time says which instant they belong to."""
    write(tmp_path, pattern, fps=25.0)
    source = open_capture(tmp_path)
    assert (len(source), source.fps, source.rig.testing) == (FRAMES, 25.0, ())
    for camera, name in zip(CAMERAS, source.rig, strict=True):
        np.testing.assert_allclose(source.rig[name].center.numpy(), camera.center, atol=1e-9)
        expected = [[40.0, 0, WIDTH / 2], [0, 40, HEIGHT / 2], [0, 0, 1]]
        torch.testing.assert_close(source.rig[name].K, torch.tensor(expected, dtype=torch.float64))
    assert all_numbers(source.frames()) == [[(camera, frame) for camera in range(3)] for frame in range(FRAMES)]


@pytest.mark.parametrize(
    ("angles", "expected"), [("x", (40, 40)), ("y", (44, 44)), ("xy", (40, 44)), ("", (41, 41))]
)  # pixels are square where one axis is stated
def test_angles_give_the_focal_lengths(tmp_path: Path, angles: str, expected: tuple[float, float]) -> None:
    spans = {"x": WIDTH / 2 / 40, "y": HEIGHT / 2 / 44}
    stated = {f"camera_angle_{axis}": 2 * math.atan(spans[axis]) for axis in angles} or {"fl_y": 41}
    write(tmp_path, "rgb/CAM/FRAME.png", **{"camera_angle_x": None, **stated})
    found = [camera.K.diagonal()[:2].tolist() for camera in open_capture(tmp_path).rig.cameras.values()]
    np.testing.assert_allclose(found, [expected] * 3)


@pytest.mark.parametrize("fps", [0, -30, float("nan"), "fast"])
def test_a_rate_that_is_none(tmp_path: Path, fps: object) -> None:
    write(tmp_path, "rgb/CAM/FRAME.png", fps=fps)
    with pytest.raises(CalibrationError, match=r"transforms\.json cannot be read \(.*; expected fps as a number"):
        open_capture(tmp_path)


@pytest.mark.parametrize("last", [1.0, 0.5, -10.0])
def test_times_order_the_pictures_not_their_names(tmp_path: Path, last: float) -> None:
    """Negative ones too, as of takes that are counted from their middle."""
    write(tmp_path, "rgb/CAM/FRAME.png")
    edit_frames(tmp_path / "transforms.json", lambda entry: entry.update(time=last - entry["time"]))
    expected = [[(camera, frame) for camera in range(3)] for frame in reversed(range(FRAMES))]
    assert all_numbers(open_transforms(tmp_path).frames()) == expected


def test_blenders_two_files(tmp_path: Path) -> None:
    """Paths without a suffix; what the second lists is held out."""
    write(tmp_path, "train/CAM_FRAME.png", name="transforms_train.json", cameras=range(2))
    write(tmp_path, "test/CAM_FRAME.png", name="transforms_test.json", cameras=range(2, 3))
    for name in ("transforms_train.json", "transforms_test.json"):
        edit_frames(
            tmp_path / name, lambda entry: entry.update(file_path=f"./{entry['file_path'].removesuffix('.png')}")
        )
    source = open_capture(tmp_path)
    assert [len(source.rig.training), len(source.rig.testing)] == [2, 1]
    center = source.rig[source.rig.testing[0]].center
    np.testing.assert_allclose(center.numpy(), CAMERAS[2].center, atol=1e-9)


def test_a_static_scene_of_blender(tmp_path: Path) -> None:
    """One picture a camera, no times."""
    write(tmp_path, "train/CAM_FRAME.png", name="transforms_train.json")
    file = tmp_path / "transforms_train.json"
    edit_json(file, lambda content: content.update(frames=content["frames"][::FRAMES]))
    edit_frames(file, lambda entry: entry.pop("time"))
    source = open_capture(tmp_path)
    assert (len(source), len(source.rig)) == (1, 3)


def test_videos(tmp_path: Path) -> None:
    write_videos(tmp_path, [camera.name for camera in CAMERAS], frames=FRAMES)
    write_transforms(tmp_path, CAMERAS, pattern="NAME.mp4")
    assert len(open_transforms(tmp_path)) == FRAMES


def test_one_camera_that_moves(tmp_path: Path) -> None:
    write(tmp_path, "rgb/CAM_FRAME.png")

    def moving(content: dict) -> None:
        for number, entry in enumerate(content["frames"]):
            entry["transform_matrix"][0][3] += 0.1 * number
            entry["time"] = number / 9

    edit_json(tmp_path / "transforms.json", moving)
    with pytest.raises(CalibrationError, match="one camera that moves; expected several that stand still"):
        open_transforms(tmp_path)


def test_what_is_missing_is_named(tmp_path: Path) -> None:
    write(tmp_path, "rgb/CAM_FRAME.png")
    file = tmp_path / "transforms.json"
    whole = file.read_text()
    edit_json(file, lambda content: content["frames"][4].pop("transform_matrix"))
    with pytest.raises(CalibrationError, match=r"'rgb/cam01_0001\.png' of .*transforms\.json .*no 'transform_matrix'"):
        open_transforms(tmp_path)
    file.write_text(whole)
    edit_json(file, lambda content: content.pop("camera_angle_x"))
    with pytest.raises(CalibrationError, match="no 'fl_x or camera_angle_x'"):
        open_transforms(tmp_path)
    file.write_text(whole)
    (tmp_path / "rgb/cam02_0001.png").unlink()
    with pytest.raises(CalibrationError, match=r"'rgb/cam02_0001\.png' of .*no 'w and h'"):
        open_transforms(tmp_path)
    edit_json(file, lambda content: content.update(w=WIDTH, h=HEIGHT))
    with pytest.raises(CaptureError, match=r"cam02_0001\.png cannot be read"):
        list(open_transforms(tmp_path).frames())
    file.write_text("{")
    with pytest.raises(CalibrationError, match=r"transforms\.json cannot be read .*expected frames with file_path"):
        open_transforms(tmp_path)


@pytest.mark.parametrize("change", [{"camera_model": "EQUIRECTANGULAR"}, {"k4": 0.1}])
def test_lenses_that_are_not_known(tmp_path: Path, change: dict) -> None:
    write(tmp_path, "rgb/CAM_FRAME.png", **change)
    with pytest.raises(CalibrationError, match="which is not known here; expected PINHOLE, SIMPLE_PINHOLE, PERSP"):
        open_transforms(tmp_path)


@pytest.mark.parametrize("model", ["PINHOLE", "OPENCV", "PERSPECTIVE", None])
def test_coefficients_count_whatever_the_model_is_called(tmp_path: Path, model: str | None) -> None:
    write(tmp_path, "rgb/CAM_FRAME.png", camera_model=model, k1=-0.2)
    assert {camera.lens for camera in transforms.read(transforms.find(tmp_path)).cameras} == {RadialTangential(k1=-0.2)}


def test_a_rate_serves_files_without_times(tmp_path: Path) -> None:
    """Also where times are null, paths are of another machine, and lenses have COLMAP's names."""
    write(tmp_path, "images/CAM/FRAME.png", fps=60, camera_model="SIMPLE_RADIAL", k1=0.01, w=str(WIDTH), h=HEIGHT)
    edit_frames(
        tmp_path / "transforms.json",
        lambda entry: entry.update(time=None, file_path="D:\\scene\\" + entry["file_path"].replace("/", "\\")),
    )
    source = open_capture(tmp_path)
    assert (len(source), source.fps, list(source.rig)) == (FRAMES, 60.0, ["cam00", "cam01", "cam02"])


def test_masks_that_the_file_names_are_reported(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write(tmp_path, "rgb/CAM/FRAME.png", mask_path="masks_of_nerfstudio/0.png")
    open_capture(tmp_path)
    assert "names masks (mask_path), which are not read; copy them to masks/CAMERA/FRAME.png" in caplog.text

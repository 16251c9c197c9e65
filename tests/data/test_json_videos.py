# SPDX-License-Identifier: Apache-2.0
from pathlib import Path
from typing import Any

import pytest
import torch

from structgstream.cameras import rig_radius
from structgstream.data.dataset_layouts import open_json_videos
from structgstream.errors import CalibrationError, CaptureError
from tests.support.captures import all_numbers, edit_json, write_clip, write_shared_intrinsics


def test_own_dialect(tmp_path: Path) -> None:
    rig = write_clip(tmp_path / "clip", fps=24)
    source = open_json_videos(tmp_path / "clip")
    assert (source.name, source.fps, len(source)) == ("clip", 24.0, 6)
    assert source.rig.testing == ("cam00",)
    for name in rig:
        assert torch.equal(source.rig[name].viewmat, rig[name].viewmat)
        assert torch.equal(source.rig[name].K, rig[name].K)
        assert source.rig[name].near == 0.2
    assert all_numbers(source.frames(4)) == [[(camera, frame) for camera in range(4)] for frame in (4, 5)]


def test_shared_intrinsics_dialect(tmp_path: Path) -> None:
    rig = write_shared_intrinsics(tmp_path)
    source = open_json_videos(tmp_path)
    assert (source.fps, len(source), source.rig.testing) == (30.0, 4, ("cam00",))
    for name in rig:
        torch.testing.assert_close(source.rig[name].viewmat, rig[name].viewmat)
        assert torch.equal(source.rig[name].K, rig[name].K)
        assert source.rig[name].near == pytest.approx(0.12 * rig_radius(rig))


def test_a_calibration_without_video(tmp_path: Path) -> None:
    write_clip(tmp_path)
    (tmp_path / "cam02.mp4").unlink()
    with pytest.raises(CaptureError, match=r"cameras\.json calibrates camera 'cam02', but .* no pictures"):
        open_json_videos(tmp_path)


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"frames": 9}, CaptureError, r"share 6 frames, cameras\.json states 9"),
        ({"fps": 25}, CaptureError, "states 25 frames a second, the time stamps of its videos say 30"),
        ({"held_out": "cam00"}, CalibrationError, r"holds out 'cam00'; expected a list of names, \['cam00'\]"),
        ({"fps": 0}, CaptureError, r"cameras\.json cannot be read \(fps[: ]"),
        ({"fps": float("nan")}, CaptureError, r"cameras\.json cannot be read \(fps[: ]"),
        ({"near": -1}, CaptureError, r"cameras\.json cannot be read \(near[: ]"),
    ],
)
def test_values_that_cannot_be(tmp_path: Path, change: dict[str, Any], error: type[Exception], words: str) -> None:
    write_clip(tmp_path)
    edit_json(tmp_path / "cameras.json", lambda content: content.update(change))
    with pytest.raises(error, match=words):
        open_json_videos(tmp_path)


def test_a_singular_pose_names_the_camera(tmp_path: Path) -> None:
    write_shared_intrinsics(tmp_path)
    edit_json(tmp_path / "cameras.json", lambda content: content["cams"].__setitem__(1, [[0.0] * 4] * 4))
    with pytest.raises(CalibrationError, match=r"'cam01' of .*cameras\.json cannot be read .*expected a pose"):
        open_json_videos(tmp_path)


def of_twice_the_size(content: dict[str, Any]) -> None:
    content.update(width=2 * content["width"], height=2 * content["height"])
    for camera in content["cameras"].values():
        camera["K"] = [[2.0 * number for number in row] for row in camera["K"][:2]] + [[0.0, 0.0, 1.0]]


def test_smaller_pictures_than_the_calibration_is_for(tmp_path: Path) -> None:
    rig = write_clip(tmp_path)
    edit_json(tmp_path / "cameras.json", of_twice_the_size)
    source = open_json_videos(tmp_path)
    for name in rig:
        assert (source.rig[name].width, source.rig[name].height) == (rig[name].width, rig[name].height)
        torch.testing.assert_close(source.rig[name].K, rig[name].K)

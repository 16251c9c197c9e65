# SPDX-License-Identifier: Apache-2.0
from pathlib import Path
from typing import Any

import pytest
import torch

from structgstream.data.dataset_layouts import PANOPTIC_FPS, TEST, TRAIN, open_panoptic
from structgstream.errors import CalibrationError, CaptureError
from tests.support.captures import all_numbers, edit_json, write_panoptic


def test_cameras_poses_and_pictures(tmp_path: Path) -> None:
    rig = write_panoptic(tmp_path / "ball", cameras=12, frames=3)
    source = open_panoptic(tmp_path / "ball")
    assert list(source.rig) == [str(number) for number in range(12)]
    assert source.rig.testing == ("0",)
    assert (source.name, source.fps, len(source), source.points) == ("ball", PANOPTIC_FPS, 3, None)
    for number in range(12):
        assert torch.equal(source.rig[str(number)].viewmat, rig[f"cam{number:02d}"].viewmat)
        assert torch.equal(source.rig[str(number)].K, rig[f"cam{number:02d}"].K)
    assert all_numbers(source.frames()) == [[(camera, frame) for camera in range(12)] for frame in range(3)]


def test_without_test_metadata_nothing_is_held_out(tmp_path: Path) -> None:
    write_panoptic(tmp_path)
    (tmp_path / TEST).unlink()
    assert open_panoptic(tmp_path).rig.held_out == frozenset()


@pytest.mark.parametrize("key", ["k", "w2c"])
def test_a_camera_that_moves_is_refused(tmp_path: Path, key: str) -> None:
    write_panoptic(tmp_path)

    def move(content: dict[str, Any]) -> None:
        content[key][3][1][0][2] += 0.01

    edit_json(tmp_path / TRAIN, move)
    with pytest.raises(CalibrationError, match=r"'2' .*moves: its k or w2c changes at 2/000093\.jpg"):
        open_panoptic(tmp_path)


def test_a_missing_picture_is_an_absent_camera(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_panoptic(tmp_path)
    (tmp_path / "ims" / "2" / "000092.jpg").unlink()
    frames = list(open_panoptic(tmp_path).frames())
    assert "camera '2' lacks 1 of 5 frames, the first of them frame '000092'" in caplog.text
    assert ["".join(frame.images) for frame in frames] == ["0123", "0123", "013", "0123", "0123"]


def test_a_camera_whose_folder_is_missing_is_named(tmp_path: Path) -> None:
    write_panoptic(tmp_path)
    (tmp_path / "ims" / "3").rename(tmp_path / "ims" / "33")
    with pytest.raises(CaptureError, match="Camera '3' of .* has no frames"):
        open_panoptic(tmp_path)


@pytest.mark.parametrize("text", ["{", "[]", '{"w": 64, "h": 48}'])
def test_metadata_that_is_something_else(tmp_path: Path, text: str) -> None:
    write_panoptic(tmp_path)
    (tmp_path / TRAIN).write_text(text)
    with pytest.raises(CaptureError, match=r"train_meta\.json cannot be read \(.*expected w, h, k, w2c"):
        open_panoptic(tmp_path)


def test_a_camera_cannot_be_trained_and_held_out(tmp_path: Path) -> None:
    write_panoptic(tmp_path)
    (tmp_path / TEST).write_text((tmp_path / TRAIN).read_text())
    with pytest.raises(CaptureError, match="'1' is in both"):
        open_panoptic(tmp_path)

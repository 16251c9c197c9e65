# SPDX-License-Identifier: Apache-2.0
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from structgstream.cameras import CameraRig
from structgstream.data.open import LAYOUTS_HELP, open_capture
from structgstream.errors import CalibrationError, CaptureError, ConfigError
from tests.support.captures import (
    all_numbers,
    picture,
    small_rig,
    write_clip,
    write_n3dv,
    write_panoptic,
    write_picture,
    write_pictures,
    write_shared_intrinsics,
    write_text_model,
    write_videos,
)


def write_colmap(path: Path) -> CameraRig:
    rig = small_rig()
    write_pictures(path, "images/CAM/FRAME.png", rig, frames=4)
    write_text_model(path / "sparse" / "0", rig, [(f"{name}.png", name) for name in rig], points=np.eye(3))
    return rig


WRITERS = [write_panoptic, write_clip, write_shared_intrinsics, write_n3dv, write_colmap]


@pytest.mark.parametrize("write", WRITERS)
def test_every_layout_is_recognised(tmp_path: Path, write: Callable[[Path], CameraRig]) -> None:
    rig = write(tmp_path / "take")
    source = open_capture(str(tmp_path / "take"))
    assert source.name == "take"
    for name, camera in zip(source.rig, rig.cameras.values(), strict=True):
        torch.testing.assert_close(source.rig[name].viewmat, camera.viewmat)
        torch.testing.assert_close(source.rig[name].K, camera.K)
    assert all_numbers(source.frames(3))[0] == [(camera, 3) for camera in range(len(rig))]


@pytest.mark.parametrize("write", WRITERS)
def test_every_option_works_on_every_layout(tmp_path: Path, write: Callable[[Path], CameraRig]) -> None:
    write(tmp_path)
    last = list(open_capture(tmp_path).rig)[-1]
    source = open_capture(tmp_path, held_out=(last,), scale=0.5, start=1, frames=2, near=0.7)
    assert source.rig.testing == (last,)
    assert {(camera.width, camera.height, camera.near) for camera in source.rig.cameras.values()} == {(32, 24, 0.7)}
    assert len(source) == 2
    frames = list(source.frames())
    assert [frame.index for frame in frames] == [0, 1]
    expected = [[(camera, frame) for camera in range(len(source.rig))] for frame in (1, 2)]
    assert all_numbers(frames) == expected
    assert {image.shape for frame in frames for image in frame.images.values()} == {(24, 32, 3)}


def test_nothing_held_out_is_a_choice(tmp_path: Path) -> None:
    write_clip(tmp_path)
    assert open_capture(tmp_path).rig.testing == ("cam00",)
    assert open_capture(tmp_path, held_out=()).rig.testing == ()
    with pytest.raises(CalibrationError, match=r"'cam77'\] are not in the rig"):
        open_capture(tmp_path, held_out=("cam77",))
    with pytest.raises(CalibrationError, match="at least two training cameras"):
        open_capture(tmp_path, held_out=("cam00", "cam01", "cam02"))


@pytest.mark.parametrize("near", [0.0, -1.0, float("nan")])
def test_near_must_be_positive(tmp_path: Path, near: float) -> None:
    write_clip(tmp_path)
    with pytest.raises(ConfigError, match="near plane must be positive"):
        open_capture(tmp_path, near=near)


def test_folders_that_hold_no_capture(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="nowhere does not exist"):
        open_capture(tmp_path / "nowhere")
    with pytest.raises(CaptureError, match="is an empty folder") as caught:
        open_capture(tmp_path)
    assert LAYOUTS_HELP in str(caught.value)
    (tmp_path / "holiday.jpg").write_bytes(b"")
    with pytest.raises(CaptureError, match=r"no supported layout; it holds holiday\.jpg") as caught:
        open_capture(tmp_path)
    assert LAYOUTS_HELP in str(caught.value)
    with pytest.raises(CaptureError, match="is a file"):
        open_capture(tmp_path / "holiday.jpg")


@pytest.mark.parametrize("part", ["images", "images/cam00", "sparse", "sparse/0"])
def test_the_folder_of_a_capture_is_named_where_a_part_of_it_is_given(tmp_path: Path, part: str) -> None:
    rig = small_rig(3)
    for name in rig:
        write_picture(tmp_path / f"images/{name}/0.png", picture(0, 0))
    write_text_model(tmp_path / "sparse/0", rig, [(f"{name}/0.png", name) for name in rig])
    with pytest.raises(CaptureError, match=f"give .*{tmp_path}"):
        open_capture(tmp_path / part)


def test_what_is_not_read_is_named(tmp_path: Path) -> None:
    (tmp_path / "cam00").mkdir()
    (tmp_path / "cam00/0.dng").write_bytes(b"")
    with pytest.raises(CaptureError, match=r"cam00/0\.dng is of a kind that is not read: convert"):
        open_capture(tmp_path)
    write_videos(tmp_path, ["cam00", "cam01"], frames=2)
    with pytest.raises(CaptureError, match=r"no calibration; it holds .* structgstream prepare"):
        open_capture(tmp_path)
    (tmp_path / "rig.json").write_text("{}")
    with pytest.raises(CaptureError, match=r"no calibration that is known here; it holds .*rig\.json"):
        open_capture(tmp_path)


@pytest.mark.parametrize("write", [write_clip, write_n3dv])
@pytest.mark.parametrize("place", ["NAME.MKV", "videos/NAME.mov", "NAME/DCIM/100GOPRO/GX010001.MP4"])
def test_videos_of_any_container_and_place(tmp_path: Path, write: Callable[[Path], CameraRig], place: str) -> None:
    rig = write(tmp_path)
    for name in rig:
        file = tmp_path / place.replace("NAME", name)
        file.parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / f"{name}.mp4").rename(file)  # what it is stands within, not in its name
    assert list(open_capture(tmp_path).rig) == list(rig)

# SPDX-License-Identifier: Apache-2.0
import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from captures import all_numbers, picture, small_rig, write_picture, write_text_model, write_videos
from structgstream.data.colmap_capture import open_colmap
from structgstream.errors import CalibrationError, CaptureError

RIG = small_rig(3)
FRAMES = 4
EXPECTED = [[(camera, frame) for camera in range(3)] for frame in range(FRAMES)]


def write_pictures(path: Path, pattern: str) -> None:
    """One picture per camera and frame, at ``pattern`` with CAM and FRAME replaced."""
    for number, name in enumerate(RIG):
        for frame in range(FRAMES):
            file = pattern.replace("CAM", name).replace("FRAME", f"{frame:06d}")
            write_picture(path / file, picture(number, frame))


@pytest.mark.parametrize(
    ("pattern", "names"),
    [
        ("images/CAM/FRAME.png", ["CAM/000000.png"]),
        ("images/CAM/FRAME.png", ["CAM.jpg"]),
        ("CAM/FRAME.jpg", ["CAM/000002.jpg"]),
        ("frames/FRAME/CAM.png", ["CAM.png"]),
        ("frames/FRAME/CAM.png", ["frames/000000/CAM.png"]),
        ("FRAME/CAM.png", ["000000/CAM.png", "000001/CAM.png", "000002/CAM.png", "000003/CAM.png"]),
        ("images/CAM/FRAME.png", [f"CAM/{frame:06d}.png" for frame in range(FRAMES)]),
    ],
)
def test_folders_per_camera_and_per_frame(tmp_path: Path, pattern: str, names: list[str]) -> None:
    """The model may hold one instant or all; the layout follows from it."""
    write_pictures(tmp_path, pattern)
    images = [(file.replace("CAM", name), name) for file in names for name in RIG]
    write_text_model(tmp_path / "sparse/0", RIG, images, points=np.eye(3))
    source = open_colmap(tmp_path)
    assert list(source.rig) == list(RIG)
    assert source.rig.held_out == frozenset()
    assert source.points is not None
    assert source.points.tolist() == np.eye(3).tolist()
    for name in RIG:
        torch.testing.assert_close(source.rig[name].viewmat, RIG[name].viewmat)
    assert all_numbers(source.frames()) == EXPECTED
    assert all_numbers(source.frames(2)) == EXPECTED[2:]


@pytest.mark.parametrize("folder", ["", "videos"])
def test_videos_beside_a_model(tmp_path: Path, folder: str) -> None:
    write_videos(tmp_path / folder, list(RIG), frames=FRAMES)
    write_text_model(tmp_path / "sparse", RIG, [(f"{name}.png", name) for name in RIG], points=np.eye(3))
    write_picture(tmp_path / "images" / "cam00.png", picture(0, 0))  # what the model was made from
    source = open_colmap(tmp_path)
    assert all_numbers(source.frames()) == EXPECTED
    assert source.points is not None
    assert source.fps == 30.0


def test_a_camera_without_calibration(tmp_path: Path) -> None:
    write_pictures(tmp_path, "images/CAM/FRAME.png")
    write_text_model(tmp_path / "sparse", RIG, [(f"{name}.png", name) for name in list(RIG)[1:]])
    with pytest.raises(CalibrationError, match=r"pictures of camera 'cam00', for which .*sparse has no calibration"):
        open_colmap(tmp_path)


def test_a_calibration_that_belongs_to_nothing(tmp_path: Path) -> None:
    write_pictures(tmp_path, "images/CAM/FRAME.png")
    write_text_model(tmp_path / "sparse", RIG, [(f"other{name[-1]}.png", name) for name in RIG])
    with pytest.raises(CalibrationError, match=r"No picture of .*sparse belongs to .*'other0\.png'"):
        open_colmap(tmp_path)


def test_a_camera_that_moves(tmp_path: Path) -> None:
    write_pictures(tmp_path, "images/CAM/FRAME.png")
    images = [(f"{name}/000000.png", name) for name in RIG] + [("cam01/000001.png", "cam02")]
    write_text_model(tmp_path / "sparse", RIG, images)
    with pytest.raises(CalibrationError, match=r"'cam01' moves in .*'cam01/000000.png' and 'cam01/000001.png'"):
        open_colmap(tmp_path)


def test_a_missing_picture_in_the_middle(tmp_path: Path) -> None:
    write_pictures(tmp_path, "frames/FRAME/CAM.png")
    write_text_model(tmp_path / "sparse", RIG, [(f"{name}.png", name) for name in RIG])
    (tmp_path / "frames/000002/cam01.png").unlink()
    with pytest.raises(CaptureError, match=r"'cam01' of .* no frame for frame '000002'"):
        open_colmap(tmp_path)


def test_pictures_of_another_size_than_the_model(tmp_path: Path) -> None:
    write_pictures(tmp_path, "images/CAM/FRAME.png")
    large = RIG.mapped({name: RIG[name].resized(128, 96) for name in RIG})
    write_text_model(tmp_path / "sparse", large, [(f"{name}.png", name) for name in RIG])
    with pytest.raises(CalibrationError, match=r"64x48 pixels, .* 128x96"):
        next(open_colmap(tmp_path).frames())


def test_a_model_without_frames(tmp_path: Path) -> None:
    write_text_model(tmp_path / "sparse", RIG, [(f"{name}.png", name) for name in RIG])
    with pytest.raises(CaptureError, match="a COLMAP model but no frames"):
        open_colmap(tmp_path)
    with pytest.raises(CaptureError, match="no COLMAP model"):
        open_colmap(tmp_path / "sparse" / "elsewhere")


def test_nan_names_the_camera(tmp_path: Path) -> None:
    write_pictures(tmp_path, "images/CAM/FRAME.png")
    write_text_model(tmp_path / "sparse", RIG, [(f"{name}.png", name) for name in RIG])
    text = (tmp_path / "sparse/images.txt").read_text()
    line = next(row for row in text.splitlines() if row.endswith("cam01.png"))
    words = line.split()
    (tmp_path / "sparse/images.txt").write_text(text.replace(line, " ".join([*words[:5], "nan", *words[6:]])))
    with pytest.raises(CalibrationError, match=r"'cam01' of .*not finite"):
        open_colmap(tmp_path)


def test_cameras_may_have_pictures_of_different_sizes(tmp_path: Path) -> None:
    write_pictures(tmp_path, "images/CAM/FRAME.png")
    for frame in range(FRAMES):
        write_picture(tmp_path / f"images/cam01/{frame:06d}.png", picture(1, frame, width=32, height=24))
    mixed = RIG.mapped({**RIG.cameras, "cam01": dataclasses.replace(RIG["cam01"].resized(32, 24))})
    write_text_model(tmp_path / "sparse", mixed, [(f"{name}.png", name) for name in RIG])
    source = open_colmap(tmp_path)
    assert all_numbers(source.frames()) == EXPECTED
    assert next(source.frames()).images["cam01"].shape == (24, 32, 3)

# SPDX-License-Identifier: Apache-2.0
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from structgstream.data.open import open_capture
from structgstream.errors import CaptureError
from tests.support import captures
from tests.support.captures import all_numbers, picture, small_rig, write_picture, write_text_model, write_videos

RIG = small_rig(3)
FRAMES = 4
MODEL = [(f"{name}.png", name) for name in RIG]
EXPECTED = [[(camera, frame) for camera in range(3)] for frame in range(FRAMES)]


write_pictures = partial(captures.write_pictures, names=RIG, frames=FRAMES)


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
    source = open_capture(tmp_path)
    assert list(source.rig) == list(RIG)
    assert source.rig.held_out == frozenset()
    assert source.points is not None
    assert source.points.tolist() == np.eye(3).tolist()
    for name in RIG:
        torch.testing.assert_close(source.rig[name].viewmat, RIG[name].viewmat)
    assert all_numbers(source.frames()) == EXPECTED
    assert all_numbers(source.frames(2)) == EXPECTED[2:]


@pytest.mark.parametrize(("root", "frames"), [("frames", 3), ("frames", 4), ("images", 4)])
def test_frames_and_cameras_of_the_same_numbers(tmp_path: Path, root: str, frames: int) -> None:
    """``frames`` holds frames; elsewhere the layout in which every folder and picture has a pose is taken."""
    for camera in range(3):
        for frame in range(frames):
            write_picture(tmp_path / f"{root}/{frame}/{camera}.png", picture(camera, frame))
    write_text_model(tmp_path / "sparse/0", RIG, [(f"{camera}.png", name) for camera, name in enumerate(RIG)])
    assert all_numbers(open_capture(tmp_path).frames()) == EXPECTED[:frames]


@pytest.mark.parametrize("folder", ["", "videos"])
def test_videos_beside_a_model(tmp_path: Path, folder: str) -> None:
    write_videos(tmp_path / folder, list(RIG), frames=FRAMES)
    write_text_model(tmp_path / "sparse", RIG, MODEL, points=np.eye(3))
    write_picture(tmp_path / "images" / "cam00.png", picture(0, 0))  # what the model was made from
    source = open_capture(tmp_path)
    assert all_numbers(source.frames()) == EXPECTED
    assert source.points is not None
    assert source.fps == 30.0


def test_a_missing_picture_is_an_absent_camera(tmp_path: Path) -> None:
    write_pictures(tmp_path, "frames/FRAME/CAM.png")
    write_text_model(tmp_path / "sparse", RIG, MODEL)
    (tmp_path / "frames/000002/cam01.png").unlink()
    absent = [set(RIG).difference(frame.images) for frame in open_capture(tmp_path).frames()]
    assert [index for index, names in enumerate(absent) if names] == [2]
    assert absent[2] == {"cam01"}
    # The range begins with it, and cam01's first picture is a later one.
    (tmp_path / "frames/000000/cam02.png").unlink()
    (tmp_path / "frames/000001/cam01.png").unlink()
    assert set(RIG).difference(next(open_capture(tmp_path).frames()).images) == {"cam01"}


@pytest.mark.parametrize("folder", ["images", "images_2", "images_4", "images_8", ""])
def test_reduced_pictures_scale_the_intrinsics(tmp_path: Path, folder: str) -> None:
    """257 / 4 is 64.25: the picture's own size counts, not the factor."""
    write_pictures(tmp_path / folder, "CAM/FRAME.png")
    large = RIG.mapped({name: RIG[name].resized(257, 193) for name in RIG})
    write_text_model(tmp_path / "sparse", large, MODEL)
    source = open_capture(tmp_path)
    for name in RIG:
        torch.testing.assert_close(source.rig[name].K, RIG[name].K)
        assert (source.rig[name].width, source.rig[name].height) == (64, 48)
    assert all_numbers(source.frames()) == EXPECTED


def test_full_pictures_are_preferred_to_reduced_ones(tmp_path: Path) -> None:
    write_pictures(tmp_path, "images/CAM/FRAME.png")
    for number, name in enumerate(RIG):
        for frame in range(FRAMES):
            small = picture(number, frame, width=32, height=24)
            write_picture(tmp_path / "images_2" / name / f"{frame:06d}.png", small)
    write_text_model(tmp_path / "sparse", RIG, MODEL)
    assert open_capture(tmp_path).rig["cam00"].width == 64


@pytest.mark.parametrize("folder", ["images", "images_4", ""])
@pytest.mark.parametrize("suffix", ["jpg", "png", "bmp"])
def test_a_static_folder_is_a_capture_of_one_frame(tmp_path: Path, folder: str, suffix: str) -> None:
    for number, name in enumerate(RIG):
        write_picture(tmp_path / folder / f"{name}.{suffix}", picture(number, 7))
    write_text_model(tmp_path / "sparse/0", RIG, [(f"{name}.JPG", name) for name in RIG], points=np.eye(3))
    source = open_capture(tmp_path)
    assert (len(source), list(source.rig), source.rig.held_out) == (1, list(RIG), frozenset())
    assert source.points is not None
    assert all_numbers(source.frames()) == [[(camera, 7) for camera in range(3)]]


def test_photos_that_the_model_could_not_place_are_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for number, name in enumerate(RIG):
        write_picture(tmp_path / "images" / f"{name}.png", picture(number, 7))
    write_picture(tmp_path / "images/blurred.png", picture(9, 7))
    write_text_model(tmp_path / "sparse/0", RIG, MODEL)
    assert list(open_capture(tmp_path).rig) == list(RIG)
    assert "has no pose of camera 'blurred' of " in caplog.text


@pytest.mark.parametrize("videos", [False, True])
def test_a_model_with_lenses_is_undistorted(tmp_path: Path, videos: bool) -> None:
    """The pose stays, nothing is black, and the pictures are those of the right camera and frame."""
    if videos:
        write_videos(tmp_path, list(RIG), frames=FRAMES)
    else:
        write_pictures(tmp_path, "images/CAM/FRAME.png")
    write_text_model(tmp_path / "sparse", RIG, MODEL, points=np.eye(3))
    lenses = ["OPENCV 64 48 40 40 32 24 -0.05 0.01 0.001 0", "OPENCV_FISHEYE 64 48 40 40 32 24 0.01 0 0 0"]
    cameras = [f"{number} {lens}" for number, lens in enumerate([*lenses, "PINHOLE 64 48 40 40 32 24"], start=1)]
    (tmp_path / "sparse/cameras.txt").write_text("\n".join(cameras))
    source = open_capture(tmp_path)
    assert source.points is not None
    assert torch.equal(source.rig["cam02"].K, RIG["cam02"].K)
    for name in RIG:
        torch.testing.assert_close(source.rig[name].viewmat, RIG[name].viewmat)
        assert source.rig[name].near == source.rig["cam02"].near
    assert float(source.rig["cam00"].K[0, 0]) != pytest.approx(40, abs=0.1)
    assert all_numbers(source.frames(1)) == EXPECTED[1:]


def test_a_model_without_frames(tmp_path: Path) -> None:
    write_text_model(tmp_path / "sparse", RIG, MODEL)
    with pytest.raises(CaptureError, match="has the calibration .*sparse but no frames"):
        open_capture(tmp_path)


def test_cameras_may_have_pictures_of_different_sizes(tmp_path: Path) -> None:
    write_pictures(tmp_path, "images/CAM/FRAME.png")
    for frame in range(FRAMES):
        write_picture(tmp_path / f"images/cam01/{frame:06d}.png", picture(1, frame, width=32, height=24))
    mixed = RIG.mapped({**RIG.cameras, "cam01": RIG["cam01"].resized(32, 24)})
    write_text_model(tmp_path / "sparse", mixed, MODEL)
    source = open_capture(tmp_path)
    assert all_numbers(source.frames()) == EXPECTED
    assert next(source.frames()).images["cam01"].shape == (24, 32, 3)

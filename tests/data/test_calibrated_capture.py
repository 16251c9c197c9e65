# SPDX-License-Identifier: Apache-2.0
"""A folder of videos or pictures with a calibration of another tool, through the door."""

import pickle
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from structgstream.data.dataset_layouts import bundled_clip
from structgstream.data.lenses import LensCamera, Pinhole
from structgstream.data.open import open_capture
from structgstream.data.undistortion import UndistortedSource, Undistortion
from structgstream.errors import CalibrationError
from structgstream.pose_check.check import check_poses
from tests.support.calibrations import WRITERS, Floats, Truth, truths, write_anipose, write_easymocap
from tests.support.captures import HEIGHT, WIDTH, Picture, all_numbers, write_picture, write_pictures, write_videos
from tests.support.small_clip import CAMERAS

NAMES = ["cam00", "cam01", "cam02"]
EXPECTED = [[(camera, frame) for camera in range(3)] for frame in range(3)]


@pytest.mark.parametrize(
    ("tool", "videos"), [*((tool, False) for tool in WRITERS), ("anipose", True), ("cmu_panoptic", True)]
)
def test_every_tool_with_pictures_or_videos(tool: str, videos: bool, tmp_path: Path) -> None:
    """Undistorted, at the poses of the file, with the pictures of the right cameras."""
    cameras = truths(dist=(-0.1, 0.03, 0.002, -0.001, 0.0))
    WRITERS[tool](tmp_path, cameras)
    names = [f"hd_{name}" for name in NAMES] if tool == "cmu_panoptic" and videos else NAMES
    if videos:
        write_videos(tmp_path / ("hdVideos" if tool == "cmu_panoptic" else ""), names, frames=3)
    else:
        write_pictures(tmp_path, "images/CAM/FRAME.png", NAMES, frames=3)
    source = open_capture(tmp_path)
    assert isinstance(source, UndistortedSource)
    assert list(source.rig) == names
    assert source.rig.testing == ()
    first = source.rig[names[0]].viewmat
    for name, truth in zip(names, cameras):
        expected = torch.from_numpy(truth.viewmat)
        if tool in ("multical", "kalibr"):
            expected = expected @ torch.from_numpy(cameras[0].viewmat).inverse() @ first
        torch.testing.assert_close(source.rig[name].viewmat, expected, atol=1e-6, rtol=0)
    assert all_numbers(source.frames()) == EXPECTED


def test_a_camera_that_is_broken_is_named(tmp_path: Path) -> None:
    file = write_anipose(tmp_path, truths())
    write_videos(tmp_path, NAMES, frames=2)
    text = file.read_text()
    file.write_text(text.replace("rotation = ", "turned = ", 1))
    with pytest.raises(CalibrationError, match=r"Camera 'cam00' of .*calibration\.toml cannot be read \(no 'rotation'"):
        open_capture(tmp_path)
    file.write_text(text.replace("distortions = [", "distortions = [0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1, ", 1))
    with pytest.raises(CalibrationError, match=r"'cam00' of .*12 distortion coefficients; expected 4, 5 or 8"):
        open_capture(tmp_path)
    file.write_text(text[:200])
    with pytest.raises(CalibrationError, match=r"calibration\.toml cannot be read .*aniposelib"):
        open_capture(tmp_path)


def test_half_of_easymocap(tmp_path: Path) -> None:
    write_easymocap(tmp_path, truths())
    (tmp_path / "extri.yml").unlink()
    with pytest.raises(CalibrationError, match=r"extri\.yml cannot be read \(No such file or directory"):
        open_capture(tmp_path)


def test_pickles_are_refused(tmp_path: Path) -> None:
    (tmp_path / "cam0.pickle").write_bytes(pickle.dumps({"K": 1}))
    write_videos(tmp_path, NAMES, frames=2)
    words = r"cam0\.pickle is a pickle, and opening it could run any program; it is"
    with pytest.raises(CalibrationError, match=words):
        open_capture(tmp_path)


def through_a_lens(image: Picture, K: Floats, dist: tuple[float, ...]) -> Picture:
    """The picture that a lens would have taken, by OpenCV: its pixels undistorted are those of ``image``."""
    height, width = image.shape[:2]
    centers = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).astype(np.float64).reshape(-1, 1, 2)
    straight = cv2.undistortPoints(centers, K, np.array(dist), P=K).reshape(height, width, 2).astype(np.float32)
    return np.asarray(cv2.remap(image, straight[..., 0], straight[..., 1], cv2.INTER_CUBIC), np.uint8)


def test_the_clip_through_a_lens(tmp_path: Path) -> None:
    """Pictures of a known scene, distorted, and the calibration in a file: they come back and agree with the poses."""
    clip = bundled_clip()
    frame = next(clip.frames())
    dist = (0.12, -0.03, 0.001, -0.001, 0.0)
    cameras = []
    for name in CAMERAS:
        camera = clip.rig[name]
        K = camera.K.numpy() - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
        cameras.append(Truth(name, K, dist, camera.viewmat[:3, :3].numpy(), camera.viewmat[:3, 3].numpy()))
        write_picture(tmp_path / "images" / f"{name}.png", through_a_lens(frame.images[name], K, dist))
    write_anipose(tmp_path, cameras)
    file = tmp_path / "calibration.toml"
    file.write_text(file.read_text().replace(f"size = [ {WIDTH}, {HEIGHT},]", "size = [ 320, 240,]"))
    source = open_capture(tmp_path)
    (made,) = source.frames()
    for name in source.rig:
        straight = Undistortion(LensCamera(clip.rig[name], Pinhole()), source.rig[name])
        assert straight.shown is None  # within the picture that the clip has
        truth = straight(frame.images[name])
        error = ((made.images[name].astype(float) - truth.astype(float)) ** 2).mean()
        assert 10 * np.log10(255**2 / error) > 33
    check = check_poses(made, source.rig)
    assert check.conclusive
    assert check.share_violating < 0.1

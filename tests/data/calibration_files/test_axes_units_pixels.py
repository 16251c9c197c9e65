# SPDX-License-Identifier: Apache-2.0
"""Every converter against OpenCV's projection of one made rig: axes, units, order of coefficients, pixel centres."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from structgstream.data import transforms
from structgstream.data.calibration import Calibration
from structgstream.data.calibration_files import tools
from structgstream.data.calibration_files.opencv_cameras import OPENCV_CAMERAS
from tests.support.calibrations import POINTS, WRITERS, pixels, truths
from tests.support.captures import HEIGHT, WIDTH

FORMATS = {
    "anipose": tools.ANIPOSE,
    "easymocap": tools.EASYMOCAP,
    "multical": tools.MULTICAL,
    "kalibr": tools.KALIBR,
    "cmu_panoptic": tools.CMU_PANOPTIC,
    "qualisys": tools.QUALISYS,
    "zju_mocap": tools.ZJU_MOCAP,
    "opencv_cameras": OPENCV_CAMERAS,
    "openpose": OPENCV_CAMERAS,
}
RELATIVE = ("multical", "kalibr")  # their world is the first camera
WITHOUT_SIZE = ("zju_mocap", "openpose")


def converted(tool: str, folder: Path) -> Calibration:
    if tool == "transforms":
        return transforms.read(transforms.find(folder))
    return FORMATS[tool].read(next(iter(FORMATS[tool].find(folder))))


@pytest.mark.parametrize("tool", WRITERS)
def test_pixels_are_those_of_opencv(tool: str, tmp_path: Path) -> None:
    dist = (-0.1, 0.03, 0.002, -0.001) if tool == "kalibr" else (-0.1, 0.03, 0.002, -0.001, 0.01)
    cameras = truths(dist=dist)
    WRITERS[tool](tmp_path, cameras)
    found = converted(tool, tmp_path).cameras[:3]
    points = POINTS
    if tool in RELATIVE:
        points = POINTS @ cameras[0].R.T + cameras[0].T
    for truth, camera in zip(cameras, found, strict=True):
        np.testing.assert_allclose(pixels(camera, points), truth.pixels(POINTS), atol=1e-7)
        assert camera.size == (None if tool in WITHOUT_SIZE else (WIDTH, HEIGHT))


@pytest.mark.parametrize("tool", ["anipose", "kalibr", "multical", "opencv_cameras", "transforms"])
def test_fisheyes(tool: str, tmp_path: Path) -> None:
    cameras = [replace(camera, fisheye=True) for camera in truths(dist=(0.05, -0.01, 0.002, -0.001))]
    WRITERS[tool](tmp_path, cameras)
    points = POINTS @ cameras[0].R.T + cameras[0].T if tool in RELATIVE else POINTS
    for truth, camera in zip(cameras, converted(tool, tmp_path).cameras, strict=True):
        np.testing.assert_allclose(pixels(camera, points), truth.pixels(POINTS), atol=1e-7)


@pytest.mark.parametrize("tool", WRITERS)
def test_a_folder_without_such_a_file(tool: str, tmp_path: Path) -> None:
    (tmp_path / "notes.toml").write_text("[tool]\nx = 1\n")
    (tmp_path / "other.json").write_text("{}")
    (tmp_path / "config.yaml").write_text("a: 1\n")
    (tmp_path / "layout.xml").write_text("<html/>")
    assert not [*(transforms if tool == "transforms" else FORMATS[tool]).find(tmp_path)]

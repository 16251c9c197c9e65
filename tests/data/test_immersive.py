# SPDX-License-Identifier: Apache-2.0
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from structgstream.cameras import Camera
from structgstream.data.dataset_layouts import open_immersive, read_models
from structgstream.data.lenses import Fisheye, LensCamera
from structgstream.data.open import open_capture
from structgstream.data.undistortion import UndistortedSource, Undistortion
from tests.support.calibrations import pixels
from tests.support.captures import all_numbers, write_immersive


def test_fisheye_videos_become_pinholes_of_half_the_focal_length(tmp_path: Path) -> None:
    """The videos have half of the pixels that the file is for, and so have the pinholes."""
    rig = write_immersive(tmp_path)
    source = open_immersive(tmp_path)
    assert isinstance(source, UndistortedSource)
    assert source.filmed["camera_0002"].lens == Fisheye(0.02, -0.003)
    assert source.rig.testing == ("camera_0001",)
    for name in rig:
        torch.testing.assert_close(source.rig[name].viewmat, rig[name].viewmat)
        torch.testing.assert_close(source.rig[name].K, rig[name].K)
    assert all_numbers(source.frames(1)) == [[(camera, frame) for camera in range(4)] for frame in (1, 2)]


def test_the_layout_is_recognised_and_halved_as_published(tmp_path: Path) -> None:
    rig = write_immersive(tmp_path)
    source = open_capture(tmp_path, scale=0.5, start=1)
    for name in rig:
        torch.testing.assert_close(source.rig[name].K, rig[name].resized(128, 96).K)
    assert next(source.frames()).images["camera_0002"].shape == (96, 128, 3)
    assert all_numbers(source.frames(1)) == [[(camera, 2) for camera in range(4)]]


def test_a_video_without_calibration_is_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """02_Flames has 46 videos and calibrates 45."""
    write_immersive(tmp_path)
    (tmp_path / "camera_0003.mp4").rename(tmp_path / "camera_0009.mp4")
    assert list(open_immersive(tmp_path).rig) == ["camera_0001", "camera_0002", "camera_0004"]
    assert "has no pose of camera 'camera_0009' of " in caplog.text


def test_the_example_that_the_data_set_prints(tmp_path: Path) -> None:
    """Where the first camera sees the point (0.5, 0.5, 10), and which part of the published pinhole the lens fills."""
    entry = {
        "name": "camera_0001",
        "position": [0.003311238794086777, 0.000126384684934784, 0.42421246053630285],
        "orientation": [-0.03295944563072383, 0.02964606619481096, -0.03337751007195316],
        "focal_length": 1111.3638715594666,
        "pixel_aspect_ratio": 1.0,
        "principal_point": [1284.7296468363463, 925.4651609728676],
        "height": 1920.0,
        "width": 2560.0,
        "radial_distortion": [0.0970525284520715, -0.01708587111009977, 0.0],
        "projection_type": "fisheye",
    }
    (tmp_path / "models.json").write_text(json.dumps([entry]))
    (camera,) = read_models(tmp_path / "models.json").cameras
    seen = pixels(camera, np.array([[0.5, 0.5, 10.0]]))
    np.testing.assert_allclose(seen, [[1377.85525 + 0.5, 1017.6144 + 0.5]], atol=0.02)
    lens = LensCamera(Camera(torch.eye(4), torch.from_numpy(camera.K), 2560, 1920), camera.lens)
    halved = torch.tensor([[0.5, 1, 1], [1, 0.5, 1], [1, 1, 1]], dtype=torch.float64)
    shown = Undistortion(lens, replace(lens.camera, K=lens.camera.K * halved).resized(1280, 960)).shown
    assert shown is not None
    assert shown.mean() == pytest.approx(0.67, abs=0.005)

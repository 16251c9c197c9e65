# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
import torch

from structgstream.cameras import CameraRig
from structgstream.data.clip import bundled_clip
from structgstream.data.pose_check import check_poses
from structgstream.errors import CalibrationError
from structgstream.frames import MultiViewFrame


@pytest.fixture(scope="module")
def clip_frame() -> MultiViewFrame:
    return next(iter(bundled_clip().frames()))


def test_right_poses_pass_with_room_to_spare(clip_frame: MultiViewFrame) -> None:
    check = check_poses(clip_frame, bundled_clip().rig)
    assert check.conclusive
    assert check.share_violating < 0.1
    assert check.median_epipolar_error_pixels < 0.7


def inverted(rig: CameraRig) -> CameraRig:
    return rig.mapped({name: replace(rig[name], viewmat=torch.linalg.inv(rig[name].viewmat)) for name in rig})


def test_camera_to_world_given_as_world_to_camera_is_named(clip_frame: MultiViewFrame) -> None:
    with pytest.raises(CalibrationError, match="camera-to-world matrices given as world-to-camera"):
        check_poses(clip_frame, inverted(bundled_clip().rig))


def test_too_little_to_judge_by_refuses_nothing() -> None:
    rig = bundled_clip().rig
    blank = {name: np.full((240, 320, 3), 128, dtype=np.uint8) for name in rig}
    assert not check_poses(MultiViewFrame(0, 0.0, blank), rig).conclusive

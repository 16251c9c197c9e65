# SPDX-License-Identifier: Apache-2.0
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from structgstream.cameras import CameraRig
from structgstream.data.dataset_layouts import bundled_clip
from structgstream.data.open import open_capture
from structgstream.data.source import resized
from structgstream.errors import CalibrationError
from structgstream.frames import MultiViewFrame
from structgstream.pose_check.check import check_poses
from tests.support.planes import room_frame, room_rig

CLIP = resized(bundled_clip(), 0.6)


@pytest.fixture(scope="module")
def clip_frame() -> MultiViewFrame:
    return next(iter(CLIP.frames()))


def test_right_poses_pass_with_room_to_spare(clip_frame: MultiViewFrame) -> None:
    check = check_poses(clip_frame, CLIP.rig)
    assert check.conclusive
    assert check.share_violating < 0.1
    assert not check.findings


def changed(rig: CameraRig, change: Callable[[torch.Tensor], torch.Tensor]) -> CameraRig:
    return rig.mapped({name: replace(rig[name], viewmat=change(rig[name].viewmat)) for name in rig})


def inverted(rig: CameraRig) -> CameraRig:
    return changed(rig, torch.linalg.inv)


def test_camera_to_world_given_as_world_to_camera_is_named(clip_frame: MultiViewFrame) -> None:
    """Other conventions: test_explanations.py."""
    with pytest.raises(CalibrationError, match="look inverted \\(camera to world in place of world to camera\\)"):
        check_poses(clip_frame, inverted(CLIP.rig))


def test_pictures_of_the_wrong_cameras_are_refused_without_a_wrong_guess(clip_frame: MultiViewFrame) -> None:
    rig = CLIP.rig
    names = list(rig)
    mixed = {name: clip_frame.images[names[(i * 3 + 1) % len(names)]] for i, name in enumerate(names)}
    with pytest.raises(CalibrationError, match="Poses and pictures do not belong together"):
        check_poses(MultiViewFrame(0, 0.0, mixed), rig)


def test_inverted_poses_of_a_flat_array_look_backwards() -> None:
    """Cameras that differ in position only keep their epipolar lines when inverted; what they see lies behind."""
    room = room_rig()
    camera = room["cam02"]
    moved = {}
    for index in range(5):
        viewmat = torch.eye(4, dtype=torch.float64)
        viewmat[:3, 3] = torch.tensor([0.3 * index - 0.6, 0.1 * (index % 2), 2.0])
        moved[f"cam{index}"] = replace(camera, viewmat=viewmat)
    rig = CameraRig(moved)
    frame = room_frame(rig)
    assert check_poses(frame, rig).share_violating < 0.1
    with pytest.raises(CalibrationError, match="look inverted \\(camera to world in place of world to camera\\)"):
        check_poses(frame, inverted(rig))


def test_held_out_pictures_stay_unread(clip_frame: MultiViewFrame) -> None:
    rig = CLIP.rig
    training = {name: clip_frame.images[name] for name in rig.training}  # A held-out name would be a KeyError.
    check_poses(MultiViewFrame(0, 0.0, training), rig)


def test_too_little_to_judge_by_refuses_nothing() -> None:
    rig = CLIP.rig
    blank = {name: np.full((144, 192, 3), 128, dtype=np.uint8) for name in rig}
    assert not check_poses(MultiViewFrame(0, 0.0, blank), rig).conclusive


def permuted(rig: CameraRig, names: list[str]) -> CameraRig:
    """The rig with the poses of these cameras handed round."""
    poses = {name: rig[other].viewmat for name, other in zip(names, [*names[1:], names[0]])}
    return rig.mapped({name: replace(rig[name], viewmat=poses.get(name, rig[name].viewmat)) for name in rig})


@pytest.mark.parametrize("wrong", [["cam02", "cam03"], ["cam01", "cam05", "cam08"]])
def test_exchanged_cameras_are_named(
    clip_frame: MultiViewFrame, wrong: list[str], caplog: pytest.LogCaptureFixture
) -> None:
    check = check_poses(clip_frame, permuted(CLIP.rig, wrong))
    assert sorted(check.off) == wrong
    assert f"Names of cameras are exchanged: the pictures of {wrong[0]!r}" in caplog.text or (
        f"The names of cameras {wrong[0]!r} and {wrong[1]!r} are exchanged" in caplog.text
    )
    caplog.clear()


def test_wrong_matches_of_cameras_far_apart_accuse_nobody(caplog: pytest.LogCaptureFixture) -> None:
    """Of examples/throw without every third camera: 43 % of the matches of cam06 and cam08 fit another geometry."""
    throw = open_capture(Path(__file__).parents[2] / "examples" / "throw")
    rig = CameraRig({name: throw.rig[name] for name in ("cam01", "cam02", "cam03", "cam06", "cam08")})
    frame = next(iter(throw.frames()))
    check = check_poses(replace(frame, images={name: frame.images[name] for name in rig}), rig)
    assert check.conclusive
    assert not check.off
    assert not caplog.text


def test_a_third_of_a_rig_is_never_permuted_silently(
    clip_frame: MultiViewFrame, caplog: pytest.LogCaptureFixture
) -> None:
    training = list(CLIP.rig.training)
    for seed in range(3):
        wrong = [training[place] for place in np.random.default_rng(seed).permutation(len(training))[:3]]
        assert check_poses(clip_frame, permuted(CLIP.rig, wrong)).off
    caplog.clear()

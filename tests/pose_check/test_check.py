# SPDX-License-Identifier: Apache-2.0
"""Mistakes in poses and intrinsics of a rig whose true cameras made the matches."""

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
from structgstream.pose_check.check import Finding, check_poses, explain
from structgstream.pose_check.verdicts import judge
from tests.support.evidence_made import Cameras, evidence_of, farther, scattered, turned, wide_ring
from tests.support.planes import room_frame, room_rig

FLIP = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))


def explained(stated: Cameras, *, true: Cameras) -> list[Finding]:
    evidence = evidence_of(true, scattered(80), noise=0.2)
    return explain(evidence, stated, judge(evidence, stated))


def test_three_names_that_went_round_are_reported_one_by_one() -> None:
    true = wide_ring(8, degrees=100)
    stated = {**true, "cam1": true["cam4"], "cam4": true["cam6"], "cam6": true["cam1"]}
    (found,) = explained(stated, true=true)
    assert set(found.cameras) == {"cam1", "cam4", "cam6"}
    for pictures, calibration in (("cam4", "cam1"), ("cam6", "cam4"), ("cam1", "cam6")):
        assert f"pictures of '{pictures}' belong to the calibration of '{calibration}'" in found.sentence


def test_two_mistakes_are_two_findings() -> None:
    true = wide_ring(9, degrees=110)
    stated = {**true, "cam2": true["cam7"], "cam7": true["cam2"], "cam4": turned(true["cam4"], 3.0)}
    exchanged, off = explained(stated, true=true)
    assert set(exchanged.cameras) == {"cam2", "cam7"}
    assert "are exchanged" in exchanged.sentence
    assert off.cameras == ("cam4",)
    assert "Camera 'cam4' is off" in off.sentence


def test_cameras_of_different_sizes_are_not_exchanged() -> None:
    """Their pictures would not fit; each is off for itself."""
    true = wide_ring(8, degrees=100)
    true["cam5"] = true["cam5"].resized(480, 360)
    stated = {**true, "cam2": true["cam5"].resized(960, 720), "cam5": true["cam2"].resized(480, 360)}
    found = explained(stated, true=true)
    assert sorted(finding.cameras for finding in found) == [("cam2",), ("cam5",)]
    assert not any("exchanged" in finding.sentence for finding in found)


@pytest.mark.parametrize(
    ("stated", "description"),
    [
        (lambda camera: replace(camera, viewmat=FLIP @ camera.viewmat), "in OpenGL axes in place of OpenCV's"),
        (lambda camera: replace(camera, viewmat=torch.linalg.inv(FLIP @ camera.viewmat)), "inverted and in OpenGL"),
        (lambda camera: farther(camera, 100.0), "centimetres among metres"),
        (lambda camera: farther(camera, 0.01), "metres among centimetres"),
        (lambda camera: farther(camera, 0.001), "metres among millimetres"),
        (
            lambda camera: replace(camera, K=camera.K * torch.tensor([[1.5], [1.5], [1.0]])),
            "intrinsics of a picture of 1440x1080 pixels, its pictures have 960x720; scale them by 0.666667",
        ),
    ],
)
def test_the_mistake_of_one_camera_is_found_among_all(stated: object, description: str) -> None:
    true = wide_ring(6, degrees=90)
    (found,) = explained({**true, "cam3": stated(true["cam3"])}, true=true)  # type: ignore[operator]
    assert found.cameras == ("cam3",)
    assert found.severity == "error"
    assert description in found.sentence


CLIP = resized(bundled_clip(), 0.6)


@pytest.fixture(scope="module")
def clip_frame() -> MultiViewFrame:
    return next(iter(CLIP.frames()))


def test_right_poses_pass_with_room_to_spare(clip_frame: MultiViewFrame, caplog: pytest.LogCaptureFixture) -> None:
    check = check_poses(clip_frame, CLIP.rig)
    assert check.conclusive
    assert check.share_violating < 0.1
    assert not caplog.text


def changed(rig: CameraRig, change: Callable[[torch.Tensor], torch.Tensor]) -> CameraRig:
    return rig.mapped({name: replace(rig[name], viewmat=change(rig[name].viewmat)) for name in rig})


def inverted(rig: CameraRig) -> CameraRig:
    return changed(rig, torch.linalg.inv)


def test_camera_to_world_given_as_world_to_camera_is_named(clip_frame: MultiViewFrame) -> None:
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


def test_exchanged_cameras_are_named(clip_frame: MultiViewFrame, caplog: pytest.LogCaptureFixture) -> None:
    check_poses(clip_frame, permuted(CLIP.rig, ["cam02", "cam03"]))
    assert [name for name in CLIP.rig if repr(name) in caplog.text] == ["cam02", "cam03"]
    assert "The names of cameras 'cam02' and 'cam03' are exchanged" in caplog.text


def test_wrong_matches_of_cameras_far_apart_accuse_nobody(caplog: pytest.LogCaptureFixture) -> None:
    """Of examples/throw without every third camera: 43 % of the matches of cam06 and cam08 fit another geometry."""
    throw = open_capture(Path(__file__).parents[2] / "examples" / "throw")
    rig = CameraRig({name: throw.rig[name] for name in ("cam01", "cam02", "cam03", "cam06", "cam08")})
    frame = next(iter(throw.frames()))
    check = check_poses(replace(frame, images={name: frame.images[name] for name in rig}), rig)
    assert check.conclusive
    assert not caplog.text


def test_a_third_of_a_rig_is_never_permuted_silently(
    clip_frame: MultiViewFrame, caplog: pytest.LogCaptureFixture
) -> None:
    training = list(CLIP.rig.training)
    for seed in range(3):
        wrong = [training[place] for place in np.random.default_rng(seed).permutation(len(training))[:3]]
        check_poses(clip_frame, permuted(CLIP.rig, wrong))
        assert all(repr(name) in caplog.text for name in wrong)
        caplog.clear()

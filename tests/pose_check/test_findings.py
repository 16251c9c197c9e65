# SPDX-License-Identifier: Apache-2.0
"""Mistakes in poses and intrinsics of a rig whose true cameras made the matches."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from structgstream.cameras import Camera
from structgstream.pose_check.check import Finding, explain
from structgstream.pose_check.verdicts import judge
from tests.support.evidence_made import Cameras, evidence_of, scattered, turned, wide_ring

FLIP = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))


def explained(stated: Cameras, *, true: Cameras) -> list[Finding]:
    evidence = evidence_of(true, scattered(80), noise=0.2)
    return explain(evidence, stated, judge(evidence, stated))


def farther(camera: Camera, factor: float) -> Camera:
    viewmat = camera.viewmat.clone()
    viewmat[:3, 3] *= factor
    return replace(camera, viewmat=viewmat)


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


def test_poses_of_another_rig_are_reported_as_such() -> None:
    """Most disagree, and no reading of all poses explains it."""
    true = wide_ring(6)
    generator = np.random.default_rng(1)
    wrong = {
        name: turned(turned(camera, generator.uniform(10, 40)), generator.uniform(10, 40), axis=0)
        for name, camera in true.items()
    }
    (found,) = explained(wrong, true=true)
    assert "do not belong together" in found.sentence
    assert found.cameras == tuple(true)

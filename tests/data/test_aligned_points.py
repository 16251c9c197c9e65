# SPDX-License-Identifier: Apache-2.0
"""Points of a model of the same cameras in other coordinates."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from structgstream.cameras import CameraRig
from structgstream.data.calibration import Calibration, PosedCamera, rigid
from structgstream.data.dataset_layouts import aligned_points
from tests.support.planes import room_rig

RIG = room_rig(5)
POINTS = np.random.default_rng(0).normal(size=(20, 3))
TURN = rigid([0.3, -0.8, 0.5], [0, 0, 0])[:3, :3]


def model(rig: CameraRig = RIG, *, names: str = "{}/000017.png", off: float = 0.0) -> Calibration:
    """The rig and its points, turned, moved and 2.5 times as large; the first camera ``off`` beside its place."""
    cameras = []
    for index, (name, camera) in enumerate(rig.cameras.items()):
        viewmat = camera.viewmat.numpy()
        turn = viewmat[:3, :3] @ TURN.T
        center = 2.5 * TURN @ camera.center.numpy() + [1.0, 2.0, 3.0] + (off if index == 0 else 0.0)
        cameras.append(PosedCamera(names.format(name), rigid(turn, -turn @ center), camera.K.numpy(), None))
    return Calibration(Path("model"), tuple(cameras), 2.5 * POINTS @ TURN.T + [1.0, 2.0, 3.0])


@pytest.mark.parametrize("names", ["{}", "{}.jpg", "{}/000017.png", "images/{}/1.png"])
def test_points_come_to_the_rig(names: str) -> None:
    found = aligned_points(model(names=names), RIG)
    assert found is not None
    np.testing.assert_allclose(found, POINTS, atol=1e-6)


def test_cameras_of_other_names_and_pictures_of_one_camera_are_no_obstacle() -> None:
    given = model()
    more = (*given.cameras, *given.cameras, PosedCamera("stranger.png", np.eye(4), np.eye(3), None))
    found = aligned_points(replace(given, cameras=more), RIG)
    assert found is not None
    np.testing.assert_allclose(found, POINTS, atol=1e-6)


def test_without_points_nothing_is_said(caplog: pytest.LogCaptureFixture) -> None:
    assert aligned_points(replace(model(), points=None), RIG) is None
    assert not caplog.records


def test_three_cameras_are_needed(caplog: pytest.LogCaptureFixture) -> None:
    given = model()
    assert aligned_points(replace(given, cameras=given.cameras[:3]), RIG) is not None
    assert not caplog.records
    assert aligned_points(replace(given, cameras=given.cameras[:2]), RIG) is None
    assert "model has 2 cameras of the rig by name; its points are not used" in caplog.text


def test_another_rig_of_the_same_names_is_refused(caplog: pytest.LogCaptureFixture) -> None:
    assert aligned_points(model(off=0.02), RIG) is not None
    assert aligned_points(model(off=2.0), RIG) is None
    assert "of the rig's extent away from the rig's; its points are not used" in caplog.text

# SPDX-License-Identifier: Apache-2.0
"""The check of captures that are said to be synchronous."""

import numpy as np
import pytest

from structgstream.cameras import CameraRig
from structgstream.data.clip import bundled_clip
from structgstream.preparation.synchronization import check_synchronization
from tests.support.takes import MadeSource, ring

RIG = CameraRig(ring(4))


def test_a_synchronous_capture() -> None:
    check = check_synchronization(MadeSource(RIG, {}))
    assert check.conclusive
    assert not check.off
    assert not check.undecided
    assert max(abs(late) for late in check.late_seconds.values()) < 0.15 / 30
    assert check.message.startswith("The cameras are synchronous within")


@pytest.mark.parametrize("frames", [1.0, -2.0, 0.5])
def test_the_camera_that_is_off_is_named(frames: float) -> None:
    check = check_synchronization(MadeSource(RIG, {"cam2": frames / 30}))
    assert check.off == ("cam2",)
    assert check.late_seconds["cam2"] == pytest.approx(frames / 30, abs=0.2 / 30)
    assert abs(check.late_seconds["cam2"] - frames / 30) < 3 * check.uncertainty_seconds["cam2"]
    assert f"Camera 'cam2' is {abs(check.late_seconds['cam2']) * 1e3:.1f} ms" in check.message
    assert ("late" if frames > 0 else "early") in check.message


def test_without_motion_it_cannot_be_told() -> None:
    check = check_synchronization(MadeSource(RIG, {}, still=True))
    assert not check.conclusive
    assert check.undecided == tuple(RIG)
    assert "cannot be told" in check.message


def test_the_bundled_clip_is_synchronous() -> None:
    check = check_synchronization(bundled_clip())
    assert check.conclusive
    assert not check.off


def test_what_time_stamps_say_is_not_late() -> None:
    """Half a frame that is known is no error of the clock; nor is it gone."""
    stated = dict.fromkeys(RIG, np.zeros(40)) | {"cam2": np.full(40, 0.5 / 30)}
    check = check_synchronization(MadeSource(RIG, {"cam2": 0.5 / 30}, apart_seconds=stated))
    assert not check.off
    assert abs(check.late_seconds["cam2"]) < 0.15 / 30
    assert check.late_against_others["cam2"] == pytest.approx(0.5 / 30, abs=0.2 / 30)
    assert check.between == {"cam2": pytest.approx(0.5 / 30)}
    assert check.message.startswith("The clocks of the cameras agree within")
    assert "the pictures of 'cam2' lie between those of the others" in check.message


def test_time_stamps_that_are_wrong() -> None:
    stated = dict.fromkeys(RIG, np.zeros(40)) | {"cam2": np.full(40, 0.4 / 30)}
    check = check_synchronization(MadeSource(RIG, {"cam2": 1.4 / 30}, apart_seconds=stated))
    assert check.off == ("cam2",)
    assert check.late_seconds["cam2"] == pytest.approx(1 / 30, abs=0.2 / 30)

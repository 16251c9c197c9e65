# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
import torch

from lab.recovery.recovery import camera_errors, clock_errors, plain, summary
from lab.rigs.filming import Filming
from lab.rigs.optics import filmed_camera
from lab.rigs.rig import base, poses, turned
from structgstream.data.calibration import Alignment
from structgstream.data.lenses import LensCamera
from structgstream.data.timeline import Clock

TRUTH = {name: filmed_camera(base(pose), Filming(lens="phone")) for name, pose in poses().items()}
ELSEWHERE = Alignment(3.7, turned("x", 40) @ turned("z", -70), np.array([5.0, -2.0, 1.0]))
STILL = dict.fromkeys(TRUTH, Clock())
TAKES = dict.fromkeys(TRUTH, (0.0, 2.0))


def errors_of(estimate: dict[str, LensCamera]) -> dict[str, dict[str, float | None]]:
    return summary(camera_errors(estimate, TRUTH, clocks=STILL, true_clocks=STILL, takes=TAKES))


def test_the_truth_elsewhere_and_in_another_unit_has_no_error() -> None:
    found = errors_of({name: ELSEWHERE.filmed(camera) for name, camera in TRUTH.items()})
    assert all((error["largest"] or 0) < 1e-5 for error in found.values())


def test_a_turned_and_moved_camera_is_measured_beside_the_others() -> None:
    estimate = dict(TRUTH)
    own = TRUTH["cam06"].camera
    moved = torch.eye(4, dtype=torch.float64)
    moved[:3, :3] = torch.from_numpy(turned("y", 0.5))
    moved[0, 3] = 0.01
    estimate["cam06"] = replace(TRUTH["cam06"], camera=replace(own, viewmat=moved @ own.viewmat))
    cameras = camera_errors(
        {name: ELSEWHERE.filmed(camera) for name, camera in estimate.items()}, TRUTH,
        clocks=STILL, true_clocks=STILL, takes=TAKES,
    )  # fmt: skip
    worst = cameras.pop("cam06")
    assert worst["rotation_degrees"] == pytest.approx(0.5, rel=0.2)
    assert all(own["rotation_degrees"] < 0.1 for own in cameras.values())
    assert worst["lens_pixels"] < 1e-6
    assert worst["position_percent"] > max(own["position_percent"] for own in cameras.values())


def test_clocks_are_compared_without_their_common_zero_and_rate() -> None:
    truth = {name: Clock(0.1 * number, 1 + 0.0001 * number) for number, name in enumerate(TRUTH)}
    other = {name: Clock(1.002 * clock.offset_seconds - 3, 1.002 * clock.rate) for name, clock in truth.items()}
    assert max(clock_errors(other, truth, TAKES).values()) < 1e-9
    late = other | {"cam03": replace(other["cam03"], offset_seconds=other["cam03"].offset_seconds + 0.02)}
    found = clock_errors(late, truth, TAKES)
    assert max(found, key=lambda name: found[name]) == "cam03"
    assert found["cam03"] == pytest.approx(0.02 * 8 / 9, rel=0.1)


def test_errors_without_a_number_are_none_in_json() -> None:
    found = {"cam00": {"rotation_degrees": 0.1, "milliseconds": float("nan")}, "cam01": {"rotation_degrees": -0.3,
             "milliseconds": float("nan")}}  # fmt: skip
    assert plain(found)["cam00"] == {"rotation_degrees": 0.1, "milliseconds": None}
    assert summary(found)["rotation_degrees"] == {"median": pytest.approx(0.2), "largest": pytest.approx(0.3)}
    assert summary(found)["milliseconds"] == {"median": None, "largest": None}

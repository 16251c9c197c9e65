# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from structgstream.preparation.calibration import mapping
from structgstream.preparation.calibration.bundle import adjust_together
from structgstream.preparation.calibration.lens_terms import ACROSS, ASPECT, DOWN, FOCAL
from structgstream.preparation.calibration.mapping import rematched
from structgstream.preparation.calibration.solved import Observations, SolvedCalibration
from tests.support.calibration_errors import calibration_errors
from tests.support.repetitive import keypoints_of, points, ring

PIXELS = 2.0
FEW = 40
COUNT = 6
ADJUST = partial(
    adjust_together,
    lens=range(COUNT),
    free=(FOCAL, ASPECT, ACROSS, DOWN),
    pixels=PIXELS,
)


def first_solution() -> SolvedCalibration:
    """What the first few points alone give."""
    cameras = ring(COUNT)
    keypoints = keypoints_of(cameras)
    point, camera = (part.ravel() for part in np.meshgrid(np.arange(FEW), np.arange(COUNT), indexing="ij"))
    pixels = np.stack([own.pixels for own in keypoints.values()])[camera, point]
    seen = Observations(point, camera, pixels, np.zeros(len(point), np.intp))
    return ADJUST(SolvedCalibration(cameras, points()[:FEW], seen))


def largest(found: SolvedCalibration) -> float:
    errors = calibration_errors(found.cameras, ring(COUNT)).values()
    return max(error.position_percent for error in errors)


def test_more_points_than_stood_out_at_first_make_cameras_more_exact() -> None:
    first = first_solution()
    keypoints = keypoints_of(ring(COUNT))
    again = rematched(first, keypoints, pixels=PIXELS, adjust=ADJUST, workers=1)
    assert len(again.observations) > 5 * len(first.observations)
    assert largest(again) < 0.6 * largest(first)
    rows = np.column_stack([again.observations.camera, again.observations.pixels])
    assert len(np.unique(rows, axis=0)) == len(rows)  # nothing is counted twice


def test_a_solution_with_enough_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mapping, "ENOUGH", FEW // 2)
    first = first_solution()
    assert rematched(first, {}, pixels=PIXELS, adjust=ADJUST, workers=1) is first


def test_a_solution_stays_if_little_is_gained_or_a_camera_loses(monkeypatch: pytest.MonkeyPatch) -> None:
    first, keypoints = first_solution(), keypoints_of(ring(COUNT))
    with monkeypatch.context() as patched:
        patched.setattr(mapping, "MIN_GAIN", 100.0)
        assert rematched(first, keypoints, pixels=PIXELS, adjust=ADJUST, workers=1) is first

    def losing(found: SolvedCalibration) -> SolvedCalibration:
        seen = found.observations
        kept = seen.camera != 2
        parts = (seen.point[kept], seen.camera[kept], seen.pixels[kept], seen.instant[kept])
        return replace(found, observations=Observations(*parts))

    assert rematched(first, keypoints, pixels=PIXELS, adjust=losing, workers=1) is first

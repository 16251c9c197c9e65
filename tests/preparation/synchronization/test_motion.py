# SPDX-License-Identifier: Apache-2.0
"""Motion of made takes under a known geometry, from changed pictures to clocks."""

from collections.abc import Mapping
from functools import cache

import numpy as np
import pytest

from structgstream.data.timeline import Clock
from structgstream.errors import CaptureError
from structgstream.preparation.synchronization.changes import Changes, picture_changes
from structgstream.preparation.synchronization.geometry import CalibratedGeometry
from structgstream.preparation.synchronization.motion import agreeing_cameras, pair_signals, solve_by_motion
from takes import MadeStreams, lenses, ring

VIEWS = ring(4)
OFFSETS = {"cam0": 0.0, "cam1": 0.35, "cam2": -0.2333, "cam3": 0.5167}


@cache
def changes(count: int = 60) -> Mapping[str, Changes]:
    """Of two seconds of four cameras at 30 and, the last, at 24 frames a second."""
    stamps = {name: np.arange(count) / (24 if name == "cam3" else 30) for name in VIEWS}
    streams = MadeStreams(stamps, VIEWS, {name: Clock(offset) for name, offset in OFFSETS.items()})
    return {name: picture_changes(streams.pictures(name, np.arange(count)), stamps[name]) for name in VIEWS}


def takes(count: int = 60) -> dict[str, tuple[float, float]]:
    return {name: (0.0, float(own.times[-1])) for name, own in changes(count).items()}


def test_offsets_between_frames() -> None:
    pairs = pair_signals(changes(), CalibratedGeometry(lenses(VIEWS)))
    assert len(pairs) == 6
    assert all(pair.epipolar for pair in pairs)
    solution = solve_by_motion(takes(), pairs, slack_seconds=1 / 60, drift=False)
    errors = np.array([solution.offsets[name] - OFFSETS[name] for name in VIEWS])
    errors -= errors.mean()
    assert np.abs(errors).max() < 0.15 / 30
    assert (np.abs(errors) < 3 * np.array(list(solution.sigmas.values()))).all()
    assert max(solution.sigmas.values()) < 0.2 / 30


def test_a_still_camera_has_no_signals() -> None:
    still = changes()["cam1"]
    quiet = Changes(np.zeros_like(still.amounts), still.times, still.size)
    assert still.moving
    assert not quiet.moving
    pairs = pair_signals({**changes(), "cam1": quiet}, CalibratedGeometry(lenses(VIEWS)))
    assert {name for pair in pairs for name in (pair.first, pair.second)} == {"cam0", "cam2", "cam3"}
    with pytest.raises(CaptureError, match=r"before 'cam1' cannot be recognised .* 'cam0', 'cam2', 'cam3'"):
        solve_by_motion(takes(), pairs, slack_seconds=1 / 60, drift=False)


def test_a_camera_of_another_take_is_left_out() -> None:
    """Its pictures are those of a camera, in reverse: as much motion, at other times."""
    own = changes()["cam2"]
    mixed = {**changes(), "cam2": Changes(own.amounts[::-1], own.times, own.size)}
    pairs = pair_signals(mixed, CalibratedGeometry(lenses(VIEWS)))
    group, solution, _ = agreeing_cameras(takes(), pairs, slack_seconds=1 / 60)
    assert group == ("cam0", "cam1", "cam3")
    assert solution is not None
    assert solution.offsets["cam1"] == pytest.approx(0.35, abs=0.01)


def test_two_seconds_of_activity_without_geometry_are_refused_or_right() -> None:
    pairs = pair_signals(changes(), None)
    assert not any(pair.epipolar for pair in pairs)
    group, solution, _ = agreeing_cameras(takes(), pairs, slack_seconds=1 / 60)
    if solution is not None:
        errors = np.array([solution.offsets[name] - OFFSETS[name] for name in group])
        assert np.abs(errors - np.median(errors)).max() < 1.5 / 30

# SPDX-License-Identifier: Apache-2.0
"""Motion of made takes under a known geometry, from changed pictures to clocks."""

from collections.abc import Mapping
from functools import cache
from itertools import combinations

import numpy as np
import pytest

from structgstream.data.timeline import Clock
from structgstream.errors import CaptureError
from structgstream.preparation.synchronization.correlation import Signal
from structgstream.preparation.synchronization.motion import (
    CalibratedGeometry,
    Changes,
    PairSignals,
    agreeing_cameras,
    pair_signals,
    picture_changes,
    solve_by_motion,
)
from tests.support.takes import MadeStreams, lenses, ring

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
    with pytest.raises(
        CaptureError,
        match=r"before 'cam1' cannot be recognised .* 'cam0', 'cam2', 'cam3'.* has [0-9.]+ s: film ten seconds",
    ):
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


def test_drift_of_a_short_take() -> None:
    """Three clocks, one of which is off by 1 in 1000, in 13 s of signals that all pairs share."""
    rates = {"a": 1.0, "b": 1.0, "c": 1 + 1e-3, "d": 1.0}
    knots = np.arange(0, 15, 0.12)
    swells = np.maximum(np.random.default_rng(1).normal(size=(24, len(knots))), 0)
    own = np.arange(390) / 30
    signals = {}
    for number, (name, rate) in enumerate(rates.items()):
        values = np.stack([np.interp(0.2 * number + rate * own, knots, row) for row in swells], axis=1)
        noise = np.random.default_rng(10 + number).normal(0, 0.1, values.shape)
        signals[name] = Signal(values + noise, 0.0, 1 / 30)
    pairs = [PairSignals(one, other, (signals[one], signals[other]), True) for one, other in combinations(rates, 2)]
    solution = solve_by_motion(dict.fromkeys(rates, (0.0, 13.0)), pairs, slack_seconds=1 / 60, drift=True)
    assert solution.rates["c"] == pytest.approx(1 + 1e-3, abs=2e-4)
    assert solution.rates["b"] == solution.rates["d"] == 1.0
    for at in (0.0, 13.0):
        found = np.array([solution.offsets[name] + solution.rates[name] * at for name in rates])
        errors = found - np.array([0.2 * number + rate * at for number, rate in enumerate(rates.values())])
        assert (np.abs(errors - errors.mean()) < 2 * np.array(list(solution.sigmas.values()))).all()


def test_few_sudden_events_say_how_little_they_tell() -> None:
    """Two of four cameras film half a frame later than the others what jumps at a few instants: chance says in which of
    two frames of theirs a jump lies, so all their pairs err together."""
    strength = np.array([sudden(seed) for seed in range(40)])
    assert strength.max() < 3
    assert np.sqrt(np.mean(strength**2)) < 1.5


def sudden(seed: int) -> float:
    """The largest error of a clock over its standard error."""
    generator = np.random.default_rng(seed)
    jumps = 1 + generator.choice(150, 16, replace=False)  # in half frames, of 2.5 s
    size = generator.uniform(0.5, 1.5, (16, 16))
    late = {"a": 0, "b": 0, "c": 1, "d": 1}
    signals = {}
    for number, (name, half) in enumerate(late.items()):
        values = np.random.default_rng(100 * seed + number).normal(0, 0.1, (76, 16))
        np.add.at(values, (jumps - half) // 2, size)
        signals[name] = Signal(values, 0.0, 1 / 30)
    pairs = [PairSignals(one, other, (signals[one], signals[other]), True) for one, other in combinations(late, 2)]
    solution = solve_by_motion(dict.fromkeys(late, (0.0, 2.5)), pairs, slack_seconds=1 / 60, drift=False)
    errors = np.array([solution.offsets[name] - half / 60 for name, half in late.items()])
    return float((np.abs(errors - errors.mean()) / np.array(list(solution.sigmas.values()))).max())

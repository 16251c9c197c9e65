# SPDX-License-Identifier: Apache-2.0
"""Motion of made takes under a known geometry, from changed pictures to clocks.

Changes of pictures.

Epipolar geometry from calibrations and from static features.
"""

from collections.abc import Mapping
from functools import cache
from itertools import combinations

import cv2
import numpy as np
import pytest

from structgstream.cameras import Camera
from structgstream.data.lenses import LensCamera, Pinhole, RadialTangential
from structgstream.data.matching import epipolar_errors
from structgstream.data.timeline import Clock
from structgstream.errors import CaptureError
from structgstream.preparation.synchronization.correlation import Signal
from structgstream.preparation.synchronization.motion import (
    BUNDLES,
    CalibratedGeometry,
    Changes,
    PairGeometry,
    PairSignals,
    StaticGeometry,
    agreeing_cameras,
    line_signals,
    pair_signals,
    picture_changes,
    solve_by_motion,
    static_features,
)
from tests.support.takes import HEIGHT, WIDTH, MadeStreams, lenses, ring

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
        match=r"in the pictures of 'cam1' is not found again .* 'cam0', 'cam2', 'cam3'.* s of the shortest: film ten",
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
    pairs = pair_signals(changes(), CalibratedGeometry({}))
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


STAMPS = np.array([0.0, 0.1, 0.25, 0.3])


def pictures(*, square: bool = True, noise: float = 2.0) -> list[np.ndarray]:
    """Grey with noise, and a bright square that jumps to the right at the third picture."""
    generator = np.random.default_rng(0)
    made = []
    for index in range(4):
        picture = generator.normal(100, noise, (120, 200, 3))
        if square:
            left = 40 if index < 2 else 120
            picture[50:80, left : left + 30] += 80
        made.append(np.clip(picture, 0, 255).astype(np.uint8))
    return made


def test_changes_are_where_and_when_something_moves() -> None:
    changes = picture_changes(pictures(), STAMPS)
    assert changes.amounts.shape == (3, 96, 160)
    assert np.allclose(changes.times, [0.05, 0.175, 0.275])
    assert changes.activity.argmax() == 1
    assert changes.moving
    jump = changes.amounts[1]
    assert jump[52, 44] > 40  # the middle of where it was, in reduced pixels
    assert jump[52, 108] > 40
    assert jump[:30].max() < 10


def test_noise_is_no_motion() -> None:
    for noise in (0.0, 2.0, 8.0):
        assert not picture_changes(pictures(square=False, noise=noise), STAMPS).moving


def test_one_picture_has_no_changes() -> None:
    changes = picture_changes(pictures()[:1], STAMPS)
    assert len(changes.times) == 0
    assert not changes.moving


CAMERAS = {name: LensCamera(camera, RadialTangential(k1=-0.1, p1=0.01)) for name, camera in ring(3).items()}


def spots(name: str, points: np.ndarray) -> Changes:
    """Changes of one pixel a frame: where each point ``[T, 3]`` is seen."""
    amounts = np.zeros((len(points), HEIGHT, WIDTH), np.uint8)
    pixels = CAMERAS[name].pixels(points)
    for frame, (x, y) in enumerate(pixels):
        amounts[frame, int(y), int(x)] = 100
    return Changes(amounts, np.arange(len(points)) / 30, (WIDTH, HEIGHT))


@pytest.mark.parametrize("pair", [("cam0", "cam1"), ("cam1", "cam2"), ("cam0", "cam2")])
def test_a_point_is_in_the_same_bundle_of_both_views(pair: tuple[str, str]) -> None:
    """Up to the next one, because a pixel has a size; whatever the depth."""
    points = np.random.default_rng(0).uniform(-0.6, 0.6, (200, 3))
    geometry = CalibratedGeometry(CAMERAS).pair(*pair)
    assert geometry is not None
    signals = line_signals(spots(pair[0], points), spots(pair[1], points), geometry)
    assert signals is not None
    seen = (signals[0].sum(1) > 0) & (signals[1].sum(1) > 0)
    assert seen.mean() > 0.9
    apart = np.abs(signals[0].argmax(1) - signals[1].argmax(1))[seen]
    assert np.minimum(apart, BUNDLES - apart).max() <= 1


def test_views_that_share_few_lines_have_no_signals() -> None:
    """The second picture is far above the first one, on rows that no line of the first meets."""
    F = np.array([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # the same rows
    views = spots("cam0", np.zeros((3, 3))), spots("cam1", np.zeros((3, 3)))
    geometry = PairGeometry(F, (lambda pixels: pixels, lambda pixels: pixels + np.array([0.0, 0.9 * HEIGHT])))
    assert line_signals(*views, PairGeometry(F, (lambda pixels: pixels, lambda pixels: pixels))) is not None
    assert line_signals(*views, geometry) is None


def test_cameras_without_calibration_or_at_one_place_have_no_geometry() -> None:
    cameras = lenses(ring(2))
    assert CalibratedGeometry(cameras).pair("cam0", "other") is None
    assert CalibratedGeometry({**cameras, "cam1": cameras["cam0"]}).pair("cam0", "cam1") is None


def textured(camera: Camera) -> np.ndarray:
    """Two textured planes at different depths, as the camera sees them."""
    generator = np.random.default_rng(3)
    picture = np.zeros((camera.height, camera.width, 3), np.uint8)
    for depth, side in ((1.5, 5.0), (0.0, 1.6)):
        texture = cv2.resize(generator.integers(0, 255, (60, 60), np.uint8), (480, 480), interpolation=cv2.INTER_CUBIC)
        corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * side / 2 + [0, 0, depth]
        pixels = LensCamera(camera, Pinhole()).pixels(corners)
        square = np.array([[0, 0], [480, 0], [480, 480], [0, 480]], np.float32)
        H = cv2.getPerspectiveTransform(square, pixels.astype(np.float32))
        warped = cv2.warpPerspective(texture, H, (camera.width, camera.height))
        inside = cv2.warpPerspective(np.ones_like(texture), H, (camera.width, camera.height)) > 0
        picture[inside] = warped[inside][:, None]
    return picture


def test_static_features_give_the_geometry() -> None:
    cameras = {name: camera.resized(640, 480) for name, camera in ring(2, degrees=12).items()}
    features = {name: static_features([textured(camera)] * 3) for name, camera in cameras.items()}
    geometry = StaticGeometry(features, dict.fromkeys(cameras, (640, 480)))
    pair = geometry.pair("cam0", "cam1")
    assert pair is not None
    assert pair.estimated
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 3))
    first, second = (LensCamera(camera, Pinhole()).pixels(points) for camera in cameras.values())
    assert np.median(epipolar_errors(pair.F, first, second)) < 2


def test_views_without_texture_have_no_geometry() -> None:
    blank = np.full((60, 80, 3), 90, np.uint8)
    geometry = StaticGeometry({name: static_features([blank]) for name in "ab"}, dict.fromkeys("ab", (80, 60)))
    assert geometry.pair("a", "b") is None

# SPDX-License-Identifier: Apache-2.0
"""Which cameras are off, from matches of made rigs and from errors of pairs, and by how much.

What errors mean is tried in ``test_tracks``.
"""

from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
import torch

from structgstream.cameras import Camera
from structgstream.data.matching import Pair, PairError, project
from structgstream.pose_check import verdicts
from structgstream.pose_check.tracks import Tracks
from structgstream.pose_check.verdicts import (
    Resection,
    Suspects,
    Verdict,
    explained,
    find_suspects,
    judge,
    resect,
    track_outlier,
)
from tests.support.evidence_made import Cameras, evidence_of, scattered, shifted, turned, wide_ring
from tests.support.rigs import look_at

RIG = wide_ring(7)


def judged(change: Callable[[Cameras], object] | None = None, *, points: int = 200) -> Verdict:
    """The verdict on cameras of which some were changed after they had filmed."""
    evidence = evidence_of(RIG, scattered(points), noise=0.3)
    cameras = dict(RIG)
    if change is not None:
        change(cameras)
    return judge(evidence, cameras)


def farther(cameras: Cameras) -> None:
    """Moves a camera away from everything, towards which epipolar lines run."""
    direction = cameras["cam3"].center / cameras["cam3"].center.norm()
    cameras["cam3"] = shifted(cameras["cam3"], tuple((0.15 * direction).tolist()))


def test_a_rig_that_is_right() -> None:
    found = judged()
    assert (found.suspects.off, found.doubtful, found.unchecked) == ((), (), ())
    assert not found.resections
    assert not found.suspects.everything


@pytest.mark.parametrize("name", ["cam0", "cam3", "cam6"])
def test_a_camera_that_turned_is_named_with_its_correction(name: str) -> None:
    found = judged(lambda cameras: cameras.update({name: turned(cameras[name], 1.0)}))
    assert found.suspects.off == (name,)
    assert set(found.resections) == {name}
    correction = found.resections[name]
    assert correction.better
    assert correction.given_pixels > found.suspects.limit_pixels


def test_two_cameras_that_moved() -> None:
    def change(cameras: Cameras) -> None:
        cameras["cam1"] = shifted(cameras["cam1"], (0.0, 0.1, 0.0))
        cameras["cam5"] = turned(cameras["cam5"], 2.0, axis=0)

    found = judged(change)
    assert set(found.suspects.off) == {"cam1", "cam5"} == set(found.resections)


def test_a_camera_that_moved_along_what_pairs_cannot_see_is_accused_by_points() -> None:
    """Pairs look well, points do not."""
    found = judged(farther)
    assert found.suspects.off == ("cam3",)
    assert "cam3" in found.resections


def test_a_camera_that_no_correction_explains_better_is_not_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """Points of the others lie far from where it sees them: wrong matches do that, too."""
    found = Resection(
        points=20, given_points=25, seen=60, given_pixels=50.0, corrected_pixels=40.0, degrees=1.0, degrees_error=0.1,
        share_of_distance=0.0, share_error=0.1, focal_percent=0.0, focal_error=0.1,
    )  # fmt: skip
    monkeypatch.setattr(verdicts, "resect", lambda *arguments: found)
    assert judged(farther).suspects.off == ()
    monkeypatch.setattr(verdicts, "resect", lambda *arguments: replace(found, points=30, corrected_pixels=1.0))
    assert judged(farther).suspects.off == ("cam3",)


def test_all_cameras_written_the_wrong_way_round_are_one_mistake() -> None:
    def change(cameras: Cameras) -> None:
        for name, camera in cameras.items():
            cameras[name] = type(camera)(camera.viewmat.inverse(), camera.K, camera.width, camera.height)

    found = judged(change)
    assert found.suspects.everything
    assert not found.resections


GOOD, WRONG = PairError(0.3, 0.02, 80), PairError(6.0, 0.3, 80)


def errors_of(count: int, bad: Collection[str] = (), *, wrong: PairError = WRONG) -> dict:
    """Errors of all pairs, large where a camera of ``bad`` takes part."""
    pairs = combinations([f"cam{number}" for number in range(count)], 2)
    return {pair: wrong if set(pair) & set(bad) else GOOD for pair in pairs}


def verdict(errors: Mapping[Pair, PairError], count: int) -> Suspects:
    return find_suspects(errors, wide_ring(count))


def test_a_bad_pair_of_cameras_that_fit_others_is_stray() -> None:
    errors = errors_of(6, ["cam4"]) | {("cam0", "cam1"): PairError(200.0, 0.9, 21)}
    found = verdict(errors, 6)
    assert found.off == ("cam4",)
    assert set(found.bad) == {pair for pair in errors if "cam4" in pair} | {("cam0", "cam1")}
    assert found.stray == (("cam0", "cam1"),)
    assert verdict(errors_of(6), 6).stray == ()


def test_two_that_agree_with_each_other_only_are_both_off() -> None:
    errors = errors_of(7, ["cam1", "cam5"])
    errors["cam1", "cam5"] = GOOD
    assert set(verdict(errors, 7).off) == {"cam1", "cam5"}


def test_of_equal_shares_the_larger_errors_come_first() -> None:
    """All pairs of the first two cameras are bad."""
    errors = {("cam0", "cam1"): PairError(9.0, 0.3, 50), ("cam0", "cam2"): PairError(4.0, 0.3, 50)}
    errors |= {("cam1", "cam3"): PairError(8.0, 0.3, 50), ("cam2", "cam3"): GOOD}
    assert verdict(errors, 4).off == ("cam1", "cam0")


def test_many_matches_do_not_outvote_other_pairs() -> None:
    errors = errors_of(5)
    errors["cam0", "cam1"] = PairError(8.0, 0.9, 5000)
    assert verdict(errors, 5).off == ()


def test_a_pair_is_bad_when_most_of_its_matches_violate_though_the_median_is_small() -> None:
    found = verdict(errors_of(5, ["cam2"], wrong=PairError(0.1, 0.6, 80)), 5)
    assert found.off == ("cam2",)


def test_the_limit_follows_soft_pictures_up_to_four_times_its_floor() -> None:
    """Floor of 0.75 pixels, four times the better quarter of the pairs."""
    for typical, limit in ((0.1, 0.75), (0.5, 2.0), (5.0, 3.0)):
        errors = {pair: PairError(typical, 0.0, 80) for pair in errors_of(4)}
        assert verdict(errors, 4).limit_pixels == limit
    wide = {name: camera.resized(4000, 3000) for name, camera in wide_ring(4).items()}
    assert find_suspects(errors_of(4), wide).limit_pixels == 3.0


def tracks_of(residuals: Mapping[str, float], *, points: int = 20) -> Tracks:
    """Every camera observes all points, each with one residual."""
    count = len(residuals)
    point, camera = np.tile(np.arange(points), count), np.repeat(np.arange(count), points)
    errors = np.repeat(list(residuals.values()), points).astype(float)
    return Tracks(tuple(residuals), np.zeros((points, 3)), point, camera, np.zeros((len(point), 2)), errors)


def test_points_accuse_the_camera_that_sees_them_elsewhere() -> None:
    clean = Suspects((), (), 0.75, False)
    assert track_outlier(tracks_of({"a": 0.3, "b": 0.4, "c": 0.3, "d": 5.0}), clean) == "d"
    assert track_outlier(tracks_of({"a": 0.3, "b": 0.4, "c": 0.3, "d": 0.7}), clean) is None  # hardly worse
    assert track_outlier(tracks_of({"a": 2.0, "b": 2.0, "c": 2.0, "d": 4.0}), clean) is None  # all are soft
    assert track_outlier(tracks_of({"a": 0.3, "b": 0.4, "c": 0.3, "d": 5.0}, points=10), clean) is None  # too few
    assert track_outlier(tracks_of({"a": 0.3, "b": 0.4, "d": 5.0}), clean) is None  # three do not outvote one
    known = Suspects(("d",), (), 0.75, False)
    assert track_outlier(tracks_of({"a": 0.3, "b": 0.4, "c": 0.3, "d": 5.0, "e": 0.2}), known) is None


def test_matches_with_a_camera_that_is_off_do_not_count_against_another() -> None:
    """Of cam1's 110 matches, 80 are with cam4."""
    errors = {pair: PairError(0.3, 0.02, 30) for pair in errors_of(5)} | errors_of(5, ["cam4"])
    errors |= {pair: PairError(0.3, 0.02, 10) for pair in errors if "cam1" in pair and "cam4" not in pair}
    assert verdict(errors, 5).off == ("cam4",)


NOISE = 0.3  # pixels


def true_camera() -> Camera:
    K = torch.tensor([[600.0, 0, 322], [0, 602, 239], [0, 0, 1]], dtype=torch.float64)
    eye, target = (torch.tensor(place, dtype=torch.float64) for place in ([0.3, -0.2, -3.0], [0.0, 0.0, 0.0]))
    return Camera(look_at(eye, target), K, 640, 480)


def observed(count: int = 120, *, wrong: float = 0.0, seed: int = 0) -> Tracks:
    """Points of a room as the true camera sees them, a share of them matched wrongly."""
    generator = np.random.default_rng(seed)
    points = generator.uniform([-0.8, -0.6, -0.8], [0.8, 0.6, 0.8], (count, 3))
    pixels = project(true_camera(), points)[0] + generator.normal(0, NOISE, (count, 2))
    lost = generator.random(count) < wrong
    pixels[lost] = generator.uniform([0, 0], [640, 480], (lost.sum(), 2))
    every = np.arange(count)
    return Tracks(("cam",), points, every, np.zeros(count, np.intp), pixels, np.zeros(count))


def of(given: Camera, tracks: Tracks) -> Resection:
    found = resect(tracks, given, "cam")
    assert found is not None
    return found


@pytest.mark.parametrize("wrong", [0.0, 0.3])
@pytest.mark.parametrize("degrees", [0.3, 1.0, 25.0])
def test_a_turn_is_stated(degrees: float, wrong: float) -> None:
    found = of(turned(true_camera(), degrees), observed(wrong=wrong))
    assert found.better
    assert found.degrees == pytest.approx(degrees, abs=max(3 * found.degrees_error, 0.02))
    assert found.degrees_error < 0.05
    assert (found.share_of_distance, found.focal_percent) == (0, 0)
    assert found.description.startswith(f"place it {found.degrees:.2f} degrees")


def test_a_move_is_stated() -> None:
    found = of(shifted(true_camera(), (0.0, 0.06, 0.0)), observed())
    assert found.better
    assert found.share_of_distance == pytest.approx(0.02, abs=0.003)
    assert found.degrees == 0
    assert "of its distance to the scene" in found.description


@pytest.mark.parametrize("factor", [1.02, 0.95])
def test_a_focal_length_is_stated(factor: float) -> None:
    camera = true_camera()
    K = camera.K.clone()
    K[0, 0], K[1, 1] = K[0, 0] * factor, K[1, 1] * factor
    found = of(replace(camera, K=K), observed())
    assert found.better
    assert found.focal_percent == pytest.approx(100 * (1 / factor - 1), abs=0.2)
    assert (found.degrees, found.share_of_distance) == (0, 0)
    assert ("shorter" if factor > 1 else "longer") in found.description


def test_a_good_camera_is_as_given() -> None:
    found = of(true_camera(), observed())
    assert found.as_given
    assert not found.better


@pytest.mark.parametrize(("count", "wrong"), [(120, 0.5), (16, 0.5)])
def test_wrong_matches_do_not_condemn(count: int, wrong: float) -> None:
    for seed in range(5):
        found = resect(observed(count, wrong=wrong, seed=seed), true_camera(), "cam")
        assert found is not None
        assert not found.better


def test_what_no_camera_explains_is_not_better() -> None:
    found = resect(observed(wrong=1.0), true_camera(), "cam")
    assert found is None or not (found.better or found.as_given)


def test_too_few_points_say_nothing() -> None:
    assert resect(observed(5), true_camera(), "cam") is None
    assert resect(observed(), true_camera(), "other") is None


def test_points_that_a_camera_explains_are_counted() -> None:
    tracks = observed(100, wrong=0.25, seed=3)
    assert 70 <= explained(tracks, true_camera(), "cam") <= 85
    assert explained(tracks, turned(true_camera(), 5), "cam") < 5

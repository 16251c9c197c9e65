# SPDX-License-Identifier: Apache-2.0
"""Who is off, by errors of pairs that are made up; what errors mean is tried in ``test_check``."""

from collections.abc import Collection, Mapping
from itertools import combinations

import numpy as np

from structgstream.data.matching import Pair, PairError
from structgstream.pose_check.tracks import Tracks
from structgstream.pose_check.verdicts import Suspects, find_suspects, track_outlier
from tests.support.evidence_made import wide_ring

GOOD, WRONG = PairError(0.3, 0.02, 80), PairError(6.0, 0.3, 80)


def errors_of(count: int, bad: Collection[str] = (), *, wrong: PairError = WRONG) -> dict:
    """Errors of all pairs, large where a camera of ``bad`` takes part."""
    pairs = combinations([f"cam{number}" for number in range(count)], 2)
    return {pair: wrong if set(pair) & set(bad) else GOOD for pair in pairs}


def verdict(errors: Mapping[Pair, PairError], count: int) -> Suspects:
    return find_suspects(errors, wide_ring(count))


def test_no_camera_is_off_where_all_agree() -> None:
    found = verdict(errors_of(5), 5)
    assert (found.off, found.bad, found.everything) == ((), (), False)


def test_the_camera_that_disagrees_with_all_is_off_and_nobody_else() -> None:
    found = verdict(errors_of(6, ["cam4"]), 6)
    assert found.off == ("cam4",)
    assert set(found.bad) == {pair for pair in errors_of(6) if "cam4" in pair}
    assert not found.everything


def test_a_bad_pair_of_cameras_that_fit_others_is_stray() -> None:
    errors = errors_of(6, ["cam4"]) | {("cam0", "cam1"): PairError(200.0, 0.9, 21)}
    found = verdict(errors, 6)
    assert found.off == ("cam4",)
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


def test_most_pairs_bad_is_no_single_cameras_mistake() -> None:
    found = verdict(errors_of(6, [f"cam{number}" for number in range(5)]), 6)
    assert found.everything


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

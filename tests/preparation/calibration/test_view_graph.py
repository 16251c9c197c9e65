# SPDX-License-Identifier: Apache-2.0
from itertools import combinations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from structgstream.data.matching import connected_groups
from structgstream.preparation.calibration.colmap import colmap_camera
from structgstream.preparation.calibration.mapping import verified_pairs
from tests.support.filmed import ring
from tests.support.properties import examples
from tests.support.views_made import cloud, keypoints_of, matches_of

RIG = ring(3, radius=2.6, arc_degrees=40)
CAMERAS = {name: colmap_camera(filmed, number) for number, (name, filmed) in enumerate(RIG.items(), 1)}
NAMES = [f"cam{number}" for number in range(6)]


def test_true_matches_are_kept_and_wrong_ones_go() -> None:
    points = cloud()
    matches = matches_of(RIG, points)
    true = matches["cam00", "cam01"].copy()
    wrong = np.random.default_rng(0).permutation(len(true))[: len(true) // 4]
    matches["cam00", "cam01"][wrong, 1] = np.roll(true[wrong, 1], 1)
    (geometry,) = verified_pairs(
        keypoints_of(RIG, points, noise=0.2),
        {("cam00", "cam01"): matches["cam00", "cam01"]},
        CAMERAS,
        workers=1,
    ).values()
    inliers = {tuple(row) for row in geometry.inlier_matches.tolist()}
    right = {tuple(row) for row in np.delete(true, wrong, axis=0).tolist()}
    assert right <= inliers
    assert len(inliers - right) <= 2  # a wrong match may lie on its line by chance


def test_pairs_that_agree_by_chance_or_in_a_few_points_do_not_pass() -> None:
    """Twenty matches are enough where all agree; forty and a few by chance are not, of 150."""
    points = cloud()
    matches = matches_of(RIG, points)
    keypoints = keypoints_of(RIG, points)
    shuffled = matches["cam00", "cam02"].copy()
    shuffled[40:, 1] = np.random.default_rng(0).permutation(shuffled[40:, 1])  # of 150
    found = verified_pairs(
        keypoints,
        {
            ("cam00", "cam01"): matches["cam00", "cam01"][:19],
            ("cam00", "cam02"): shuffled,
            ("cam01", "cam02"): matches["cam01", "cam02"][:20],
        },
        CAMERAS,
        workers=1,
    )
    assert set(found) == {("cam01", "cam02")}


@examples(60)
@given(st.sets(st.sampled_from(list(combinations(NAMES, 2)))))
def test_groups_are_what_pairs_connect(pairs: set[tuple[str, str]]) -> None:
    """A pair lies in one group, no smaller groups would do, and the largest comes first."""
    groups = connected_groups(NAMES, sorted(pairs))
    assert sorted(name for group in groups for name in group) == NAMES
    assert [len(group) for group in groups] == sorted(map(len, groups), reverse=True)
    assert all(list(group) == sorted(group) for group in groups)
    for group in groups:
        reached = {group[0]}
        while more := {name for pair in pairs if reached & set(pair) for name in pair} - reached:
            reached |= more
        assert reached == set(group)

# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from structgstream.data.matching import connected_groups, project
from structgstream.pose_check.tracks import build_tracks
from structgstream.preparation.checking.overlap import (
    cameras_per_point,
    coverage,
    nearest_depth,
    observed_depths,
    overlap_findings,
    overlaps,
    scale_findings,
)
from tests.support.evidence_made import Cameras, evidence_of, scattered, turned, wide_ring
from tests.support.properties import examples

NAMES = [f"cam{number}" for number in range(7)]
EVERY = list(combinations(NAMES, 2))


def test_cameras_are_counted_that_have_a_point_in_their_picture() -> None:
    cameras = wide_ring(4)
    behind_first = 1.5 * cameras["cam0"].center.numpy()
    points = np.stack([np.zeros(3), np.array([0, 50.0, 0]), behind_first])
    counts = cameras_per_point(points, cameras)
    assert counts[:2].tolist() == [4, 0]
    assert counts[2] < 4
    found = coverage(np.repeat(points[:2], [3, 1], axis=0), cameras)
    assert (found.points, found.seen_by_three, found.median_cameras) == (4, 0.75, 4.0)
    assert coverage(np.empty((0, 3)), cameras).points == 0


@examples(60)
@example({("cam0", "cam1"), ("cam2", "cam3")})  # two groups of one size: one of them is reported
@given(st.sets(st.sampled_from(EVERY), min_size=1))
def test_groups_are_those_of_the_graph(pairs: set[tuple[str, str]]) -> None:
    """All groups but the largest are reported, single cameras together; so is who has one neighbour."""
    ends = np.array([[NAMES.index(name) for name in pair] for pair in sorted(pairs)]).T
    graph = coo_matrix((np.ones(len(pairs)), ends), shape=(len(NAMES), len(NAMES)))
    count, label = connected_components(graph, directed=False)
    findings = overlap_findings(pairs, NAMES)
    apart = [finding for finding in findings if "no matches" in finding.sentence]
    reported = [set(finding.cameras) for finding in apart]
    groups = [{name for name, own in zip(NAMES, label, strict=True) if own == group} for group in range(count)]
    found = connected_groups(NAMES, sorted(pairs))
    assert sorted(found) == sorted(tuple(sorted(group)) for group in groups)
    assert [len(group) for group in found] == sorted(map(len, found), reverse=True)
    single = [group for group in groups if len(group) == 1]
    together = set().union(*single)
    assert len(reported) == count - 1 - max(len(single) - 1, 0)
    assert all(group in groups or group == together for group in reported)
    whole = set(NAMES) - set().union(*reported)
    assert len(whole) == max(map(len, groups))
    alone = {finding.cameras for finding in findings if "1 other camera only" in finding.sentence}
    assert alone == {(name,) for name, number in overlaps(pairs, NAMES).items() if number == 1 and name in whole}
    assert all(finding.severity == "warning" for finding in findings)


def test_overlaps_count_cameras() -> None:
    assert overlaps([("cam0", "cam1"), ("cam2", "cam0")], NAMES[:4]) == {"cam0": 2, "cam1": 1, "cam2": 1, "cam3": 0}


def test_two_cameras_that_overlap_are_enough_for_each_other() -> None:
    assert overlap_findings([("cam0", "cam1")], NAMES[:2]) == []


def test_a_rig_without_any_match_is_one_finding() -> None:
    (found,) = overlap_findings([], NAMES)
    assert "No two of the 7 cameras" in found.sentence
    assert found.cameras == tuple(NAMES)


WORLD = scattered(200)


def depths_of(cameras: Cameras) -> np.ndarray:
    return np.concatenate([project(camera, WORLD)[1] for camera in cameras.values()])


def reported(
    cameras: Cameras, points: np.ndarray | None = None, *, radius: float = 3.0, unit: str | None = None
) -> str:
    """The sentences of all findings, each of which is an error."""
    findings = scale_findings(depths_of(wide_ring(4)), points, cameras, radius=radius, unit=unit)
    assert all(finding.severity == "error" for finding in findings)
    return "\n".join(finding.sentence for finding in findings)


def test_depths_are_of_the_cameras_that_observed_and_are_not_off() -> None:
    cameras = wide_ring(5)
    stated = {**cameras, "cam2": turned(cameras["cam2"], 20)}
    tracks = build_tracks(evidence_of(cameras, WORLD[:60]), stated, off=["cam2"])
    found = observed_depths(tracks, stated, off=["cam2"])
    true = np.concatenate([project(cameras[name], WORLD[:60])[1] for name in cameras if name != "cam2"])
    np.testing.assert_allclose(np.sort(found), np.sort(true), atol=1e-5)


def test_the_nearest_depth_is_that_of_few_points_and_needs_some() -> None:
    depths = np.concatenate([np.linspace(2, 4, 1000), [-5.0] * 50])
    assert nearest_depth(depths) == pytest.approx(2.01, abs=0.005)  # 0.5 % of those in front are nearer
    assert nearest_depth(depths[:29]) is None


def with_near(near: float) -> Cameras:
    return {name: replace(camera, near=near) for name, camera in wide_ring(4).items()}


def test_a_near_plane_in_front_of_nearly_all_points_is_fine() -> None:
    at = float(np.percentile(depths_of(wide_ring(4)), 1))
    assert reported(with_near(at)) == ""


def test_a_near_plane_that_cuts_gets_one_that_does_not() -> None:
    depths = depths_of(wide_ring(4))
    sentence = reported(with_near(float(np.percentile(depths, 30))))
    assert "beyond 30% of the points" in sentence
    assert "units of length" not in sentence
    proposed = float(sentence.split("--near ")[1].rstrip("."))
    assert depths.min() / 3 < proposed < depths.min()
    assert "look like different units of length" in reported(with_near(3000.0))


def test_a_near_plane_in_metres_before_positions_in_millimetres_is_reported() -> None:
    depths = depths_of(wide_ring(4))
    nearest = nearest_depth(depths)
    assert nearest is not None
    cameras = with_near(0.5 * nearest)
    assert scale_findings(100 * depths, None, cameras, radius=300.0, unit=None) == []
    (found,) = scale_findings(1000 * depths, None, cameras, radius=3000.0, unit=None)
    assert found.severity == "warning"
    assert "positions in millimetres and a near plane in metres" in found.sentence
    assert float(found.sentence.split("--near ")[1].rstrip(".")) == pytest.approx(500 * nearest, rel=0.01)


@pytest.mark.parametrize(
    ("radius", "unit", "sentence"),
    [
        (3000.0, "metres", "look like millimetres or centimetres"),
        (0.003, "metres", "look like kilometres"),
        (3.0, "metres", ""),
        (3000.0, None, ""),
    ],
)
def test_a_rig_is_no_larger_than_a_stadium_and_no_smaller_than_a_hand(
    radius: float, unit: str | None, sentence: str
) -> None:
    found = reported(wide_ring(4), radius=radius, unit=unit)
    assert sentence in found
    assert bool(sentence) == bool(found)


@pytest.mark.parametrize(
    ("points", "sentence"),
    [
        (WORLD, ""),
        (0.001 * WORLD + (0, 0, 0.4), ""),  # small and in sight: no unit follows from that
        (1000 * WORLD, "1000 times too large"),
        (100 * WORLD, "100 times too large"),
        (np.add(WORLD, (0, -40, 0)), "where two cameras see them: they are of other cameras"),
        (WORLD[:20] * 1000, ""),  # too few to say anything
    ],
)
def test_points_that_came_along_must_lie_where_cameras_look(points: np.ndarray, sentence: str) -> None:
    found = reported(wide_ring(4), points)
    assert sentence in found
    assert bool(sentence) == bool(found)

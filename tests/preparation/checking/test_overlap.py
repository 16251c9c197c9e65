# SPDX-License-Identifier: Apache-2.0
from itertools import combinations

import numpy as np
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from structgstream.preparation.checking.overlap import cameras_per_point, coverage, overlap_findings, overlaps
from tests.support.evidence_made import wide_ring
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

# SPDX-License-Identifier: Apache-2.0
"""Points from keypoints that are made; from pictures they are made in ``test_refinement``."""

from functools import cache

import numpy as np

from structgstream.data.lenses import RadialTangential
from structgstream.preparation.calibration.colmap import colmap_camera
from structgstream.preparation.calibration.mapping import PosedGraph, observed, posed_model, verified_pairs, without
from tests.support.filmed import ring
from tests.support.views_made import cloud, keypoints_of, matches_of

RIG = ring(4, radius=2.6, arc_degrees=50, lens=RadialTangential(k1=-0.1))
POINTS = cloud()


@cache
def graph() -> PosedGraph:
    keypoints, matches = keypoints_of(RIG, POINTS), matches_of(RIG, POINTS)
    cameras = {name: colmap_camera(filmed, number) for number, (name, filmed) in enumerate(RIG.items(), 1)}
    geometries = verified_pairs(keypoints, matches, cameras, workers=1)
    return PosedGraph(keypoints, geometries)


def points_of(found: PosedGraph) -> tuple[np.ndarray, np.ndarray]:
    """Places and numbers of the points that the model has."""
    model = posed_model(found, RIG, pixels=1.0, slack_degrees=0.4)
    points, seen = observed(model, found.keypoints, RIG)
    which = np.array([
        np.linalg.norm(RIG["cam00"].pixels(POINTS) - RIG["cam00"].pixels(point), axis=1).argmin() for point in points
    ])  # fmt: skip
    assert len(seen) > 2 * len(points)
    return points, which


def test_points_lie_where_they_were_and_poses_stay() -> None:
    points, which = points_of(graph())
    assert len(set(which)) == len(points) > 100
    np.testing.assert_allclose(points, POINTS[which], atol=1e-4)  # keypoints are stored as float32


def test_matches_that_are_dropped_make_no_points() -> None:
    """Without the matches of the first 60 points there are no such points; the graph itself is unchanged."""
    before = {pair: len(rows) for pair, rows in graph().matches.items()}
    fewer = without(graph(), {pair: rows[:, 0] < 60 for pair, rows in graph().matches.items()})
    _, which = points_of(fewer)
    assert which.min() >= 60
    assert {pair: len(found.inlier_matches) for pair, found in graph().geometries.items()} == before

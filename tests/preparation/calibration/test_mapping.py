# SPDX-License-Identifier: Apache-2.0
"""COLMAP's mappers, its adjustment and its points on matches that are made, whose cameras are known."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from structgstream.data.lenses import LensCamera, RadialTangential
from structgstream.preparation.calibration.colmap import colmap_camera
from structgstream.preparation.calibration.mapping import (
    Mapper,
    PosedGraph,
    adjust,
    cameras_of,
    mapped,
    observed,
    posed_model,
    size_of,
    verified_pairs,
    without,
    write_database,
)
from tests.support.calibration_errors import calibration_errors
from tests.support.filmed import ring
from tests.support.views_made import cloud, keypoints_of, matches_of

RIG = ring(5, radius=2.6, arc_degrees=80)


def graph_of(rig: Mapping[str, LensCamera], *, noise: float = 0.1) -> PosedGraph:
    keypoints, matches = keypoints_of(rig, cloud(), noise=noise), matches_of(rig, cloud())
    cameras = {name: colmap_camera(filmed, number) for number, (name, filmed) in enumerate(rig.items(), 1)}
    geometries = verified_pairs(keypoints, matches, cameras, workers=1)
    return PosedGraph(keypoints, geometries)


def zoomed(factor: float) -> dict[str, LensCamera]:
    """The rig with other focal lengths."""
    found = {}
    for name, filmed in RIG.items():
        K = filmed.camera.K.clone()
        K[[0, 1], [0, 1]] *= factor
        found[name] = replace(filmed, camera=replace(filmed.camera, K=K))
    return found


@pytest.mark.parametrize("mapper", ["incremental", "global"])
def test_a_mapper_places_all_cameras(tmp_path: Path, mapper: Mapper) -> None:
    graph = graph_of(RIG)
    cameras = {name: colmap_camera(filmed, number) for number, (name, filmed) in enumerate(RIG.items(), 1)}
    database = tmp_path / "database.db"
    write_database(database, graph.keypoints, cameras, graph.geometries)
    model = mapped(database, mapper=mapper, stills=RIG)
    assert model is not None
    assert size_of(model, RIG)[0] == 5
    adjust(model)
    for error in calibration_errors(cameras_of(model), RIG).values():
        assert error.rotation_degrees < 0.06
        assert error.position_percent < 0.2
        assert abs(error.focal_percent) < 0.5


def test_adjusting_finds_focal_lengths() -> None:
    free = posed_model(graph_of(RIG), zoomed(1.03), pixels=20.0, slack_degrees=3.0)
    adjust(free)
    assert all(float(camera.camera.K[0, 0]) == pytest.approx(420, abs=2) for camera in cameras_of(free).values())


BENT = ring(4, radius=2.6, arc_degrees=50, lens=RadialTangential(k1=-0.1))


def points_of(found: PosedGraph) -> tuple[np.ndarray, np.ndarray]:
    """Places and numbers of the points that the model has."""
    model = posed_model(found, BENT, pixels=1.0, slack_degrees=0.4)
    points, seen = observed(model, found.keypoints, BENT)
    which = np.array([
        np.linalg.norm(BENT["cam00"].pixels(cloud()) - BENT["cam00"].pixels(point), axis=1).argmin() for point in points
    ])  # fmt: skip
    assert len(seen) > 2 * len(points)
    return points, which


def test_points_lie_where_they_were_and_poses_stay() -> None:
    points, which = points_of(graph_of(BENT, noise=0.0))
    assert len(set(which)) == len(points) > 100
    np.testing.assert_allclose(points, cloud()[which], atol=1e-4)  # keypoints are stored as float32


def test_matches_that_are_dropped_make_no_points() -> None:
    """Without the matches of the first 60 points there are no such points; the graph itself is unchanged."""
    graph = graph_of(BENT, noise=0.0)
    before = {pair: len(rows) for pair, rows in graph.matches.items()}
    fewer = without(graph, {pair: rows[:, 0] < 60 for pair, rows in graph.matches.items()})
    _, which = points_of(fewer)
    assert which.min() >= 60
    assert {pair: len(found.inlier_matches) for pair, found in graph.geometries.items()} == before

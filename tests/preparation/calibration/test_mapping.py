# SPDX-License-Identifier: Apache-2.0
"""COLMAP's mappers and its adjustment on matches that are made, whose cameras are known."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest

from structgstream.data.lenses import LensCamera
from structgstream.preparation.calibration.colmap import colmap_camera
from structgstream.preparation.calibration.mapping import (
    Mapper,
    PosedGraph,
    adjust,
    cameras_of,
    filtered,
    mapped,
    posed_model,
    size_of,
    verified_pairs,
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


def test_filtering_removes_what_is_far_off_or_seen_from_one_side() -> None:
    graph = graph_of(RIG)
    model = posed_model(graph, RIG, pixels=4.0, slack_degrees=1.0)
    assert filtered(model, pixels=2.0, degrees=1.5) == 0
    count = len(model.point3D_ids())
    assert filtered(model, pixels=2.0, degrees=89.0) > 0
    assert len(model.point3D_ids()) < count

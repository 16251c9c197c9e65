# SPDX-License-Identifier: Apache-2.0
"""COLMAP's pairs, mappers, adjustment and points on matches that are made, whose cameras are known."""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from structgstream.data.lenses import LensCamera, RadialTangential
from structgstream.preparation.calibration import mapping
from structgstream.preparation.calibration.bundle import adjust_together
from structgstream.preparation.calibration.colmap import colmap_cameras
from structgstream.preparation.calibration.lens_terms import ACROSS, ASPECT, DOWN, FOCAL
from structgstream.preparation.calibration.mapping import (
    Mapper,
    PosedGraph,
    adjust,
    cameras_of,
    mapped,
    observed,
    posed_model,
    rematched,
    size_of,
    verified_pairs,
    without,
    write_database,
)
from structgstream.preparation.calibration.solved import Observations, SolvedCalibration
from tests.support import repetitive
from tests.support.calibration_errors import calibration_errors
from tests.support.filmed import ring
from tests.support.views_made import cloud, keypoints_of, matches_of

THREE = ring(3, radius=2.6, arc_degrees=40)
CAMERAS = colmap_cameras(THREE)


def test_true_matches_are_kept_and_wrong_ones_go() -> None:
    points = cloud()
    matches = matches_of(THREE, points)
    true = matches["cam00", "cam01"].copy()
    wrong = np.random.default_rng(0).permutation(len(true))[: len(true) // 4]
    matches["cam00", "cam01"][wrong, 1] = np.roll(true[wrong, 1], 1)
    (geometry,) = verified_pairs(
        keypoints_of(THREE, points, noise=0.2),
        {("cam00", "cam01"): matches["cam00", "cam01"]},
        CAMERAS,
    ).values()
    inliers = {tuple(row) for row in geometry.inlier_matches.tolist()}
    right = {tuple(row) for row in np.delete(true, wrong, axis=0).tolist()}
    assert right <= inliers
    assert len(inliers - right) <= 2  # a wrong match may lie on its line by chance


def test_pairs_that_agree_by_chance_or_in_a_few_points_do_not_pass() -> None:
    """Twenty matches are enough where all agree; forty and a few by chance are not, of 150."""
    points = cloud()
    matches = matches_of(THREE, points)
    keypoints = keypoints_of(THREE, points)
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
    )
    assert set(found) == {("cam01", "cam02")}


RIG = ring(5, radius=2.6, arc_degrees=80)


def graph_of(rig: Mapping[str, LensCamera], *, noise: float = 0.1) -> PosedGraph:
    keypoints, matches = keypoints_of(rig, cloud(), noise=noise), matches_of(rig, cloud())
    return PosedGraph(keypoints, verified_pairs(keypoints, matches, colmap_cameras(rig)))


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
    database = tmp_path / "database.db"
    write_database(database, graph.keypoints, colmap_cameras(RIG), graph.geometries)
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


PIXELS = 2.0
FEW = 40
COUNT = 6
ADJUST = partial(adjust_together, lens=range(COUNT), free=(FOCAL, ASPECT, ACROSS, DOWN), pixels=PIXELS)


def first_solution() -> SolvedCalibration:
    """What the first few points alone give."""
    cameras = repetitive.ring(COUNT)
    keypoints = repetitive.keypoints_of(cameras)
    point, camera = (part.ravel() for part in np.meshgrid(np.arange(FEW), np.arange(COUNT), indexing="ij"))
    pixels = np.stack([own.pixels for own in keypoints.values()])[camera, point]
    seen = Observations(point, camera, pixels, np.zeros(len(point), np.intp))
    return ADJUST(SolvedCalibration(cameras, repetitive.points()[:FEW], seen))


def largest(found: SolvedCalibration) -> float:
    errors = calibration_errors(found.cameras, repetitive.ring(COUNT)).values()
    return max(error.position_percent for error in errors)


def test_more_points_than_stood_out_at_first_make_cameras_more_exact() -> None:
    first = first_solution()
    keypoints = repetitive.keypoints_of(repetitive.ring(COUNT))
    again = rematched(first, keypoints, pixels=PIXELS, adjust=ADJUST)
    assert len(again.observations) > 5 * len(first.observations)
    assert largest(again) < 0.6 * largest(first)
    rows = np.column_stack([again.observations.camera, again.observations.pixels])
    assert len(np.unique(rows, axis=0)) == len(rows)  # nothing is counted twice


def test_a_solution_with_enough_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mapping, "ENOUGH", FEW // 2)
    first = first_solution()
    assert rematched(first, {}, pixels=PIXELS, adjust=ADJUST) is first


def test_a_solution_stays_if_little_is_gained_or_a_camera_loses(monkeypatch: pytest.MonkeyPatch) -> None:
    first, keypoints = first_solution(), repetitive.keypoints_of(repetitive.ring(COUNT))
    with monkeypatch.context() as patched:
        patched.setattr(mapping, "MIN_GAIN", 100.0)
        assert rematched(first, keypoints, pixels=PIXELS, adjust=ADJUST) is first

    def losing(found: SolvedCalibration) -> SolvedCalibration:
        seen = found.observations
        kept = seen.camera != 2
        parts = (seen.point[kept], seen.camera[kept], seen.pixels[kept], seen.instant[kept])
        return replace(found, observations=Observations(*parts))

    assert rematched(first, keypoints, pixels=PIXELS, adjust=losing) is first

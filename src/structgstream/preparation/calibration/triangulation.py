# SPDX-License-Identifier: Apache-2.0
"""Points from matches of cameras whose poses are known, and a first solution improved by them.

Note [What a first solution lacks]: the first matches are those that stand out among all keypoints of a picture. In bare
rooms they are few and lie on walls, at one depth, where a camera's place can be exchanged for its focal length. Points
that three cameras confirm near the epipolar lines of the first solution are more, and of more depths.
"""

import logging
import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from structgstream.data.lenses import LensCamera
from structgstream.data.matching import Pair
from structgstream.preparation.calibration.adjustment import Limits, chosen
from structgstream.preparation.calibration.colmap import colmap_camera, colmap_pose, pycolmap_module
from structgstream.preparation.calibration.keypoints import Keypoints, all_keypoints
from structgstream.preparation.calibration.mapping import filtered, observed, verified_pairs, write_database
from structgstream.preparation.calibration.matching import (
    agreeing_matches,
    all_matches,
    guided_matches,
)
from structgstream.preparation.calibration.solved import Observations, SolvedCalibration

_log = logging.getLogger(__name__)

SLACK_DEGREES = 0.4  # largest angle between a ray and its point, and of a match to its epipolar plane
ENOUGH = 1000  # observations that each camera has in a first solution that is left as it is
MIN_VIEWS = 3  # cameras that see a point: two agree on their epipolar line by chance
MIN_GAIN = 1.3  # ratio of the observations then to those before; with less gain the first solution stays


@dataclass(frozen=True)
class PosedGraph:
    """Keypoints of cameras with known poses, and by pair the two-view geometry of the matches that agree with these."""

    keypoints: Mapping[str, Keypoints]
    geometries: Mapping[Pair, Any]

    @cached_property
    def matches(self) -> Mapping[Pair, NDArray[np.uint32]]:
        """Indices ``[S, 2]`` of matched keypoints of each pair."""
        return {pair: geometry.inlier_matches for pair, geometry in self.geometries.items()}


def posed_graph(
    pictures: Mapping[str, Sequence[NDArray[np.uint8]]], cameras: Mapping[str, LensCamera], *, slack_degrees: float
) -> PosedGraph:
    """Keypoints and matches near the epipolar lines of the poses, verified pair by pair without them."""
    pycolmap_module()
    workers = max(1, min(len(pictures), os.cpu_count() or 1))
    keypoints = all_keypoints({name: pictures[name] for name in cameras}, workers=workers)
    near = agreeing_matches(keypoints, all_matches(keypoints, workers=workers), cameras, degrees=slack_degrees)
    numbered = {name: colmap_camera(filmed, index) for index, (name, filmed) in enumerate(cameras.items(), 1)}
    return PosedGraph(keypoints, verified_pairs(keypoints, near, numbered, workers=workers))


def triangulated(
    graph: PosedGraph, cameras: Mapping[str, LensCamera], *, limits: Limits, slack_degrees: float = SLACK_DEGREES
) -> SolvedCalibration:
    """The cameras with the points of the graph's matches, without observations that exceed the limits."""
    model = posed_model(graph, cameras, pixels=limits.pixels, slack_degrees=slack_degrees)
    filtered(model, pixels=limits.pixels, degrees=limits.degrees)
    points, observations = observed(model, graph.keypoints, cameras)
    return SolvedCalibration(dict(cameras), points, observations)


def posed_model(
    graph: PosedGraph,
    cameras: Mapping[str, LensCamera],
    *,
    pixels: float,
    slack_degrees: float,
    models: Mapping[str, str] | None = None,
) -> Any:
    """COLMAP's model of the cameras with points triangulated from the graph's matches; poses stay.

    Args:
        pixels: largest reprojection error while points are made.
        slack_degrees: largest angle between a ray and its point while they are made.
        models: COLMAP's camera model by name, where it is not the smallest that holds the lens.
    """
    pycolmap = pycolmap_module()
    numbered = {
        name: colmap_camera(filmed, index, model=None if models is None else models[name])
        for index, (name, filmed) in enumerate(cameras.items(), 1)
    }
    model = pycolmap.Reconstruction()
    for camera in numbered.values():
        model.add_camera_with_trivial_rig(camera)
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = 0
    options.extract_colors = False
    options.mapper.filter_max_reproj_error = pixels
    making = options.triangulation
    making.create_max_angle_error = making.continue_max_angle_error = slack_degrees
    making.merge_max_reproj_error = making.complete_max_reproj_error = pixels
    making.ignore_two_view_tracks = False
    with tempfile.TemporaryDirectory(prefix="structgstream-points-") as folder:
        database = Path(folder) / "database.db"
        numbers = write_database(database, graph.keypoints, numbered, graph.geometries)
        for name, filmed in cameras.items():
            image = pycolmap.Image(name=name, camera_id=numbered[name].camera_id, image_id=numbers[name])
            image.points2D = pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in graph.keypoints[name].pixels])
            model.add_image_with_trivial_frame(image, colmap_pose(filmed.camera.viewmat.numpy()))
        made = Path(folder) / "points"
        made.mkdir()
        return pycolmap.triangulate_points(model, database, folder, made, options=options)


def without(graph: PosedGraph, dropped: Mapping[Pair, NDArray[np.bool_]]) -> PosedGraph:
    """The graph without some of its matches."""
    geometries = {}
    for pair, geometry in graph.geometries.items():
        rest = type(geometry)(geometry.todict())
        rest.inlier_matches = graph.matches[pair][~dropped[pair]]
        geometries[pair] = rest
    return PosedGraph(graph.keypoints, geometries)


def rematched(
    found: SolvedCalibration,
    keypoints: Mapping[str, Keypoints],
    *,
    limits: Limits,
    adjust: Callable[[SolvedCalibration], SolvedCalibration],
    workers: int,
) -> SolvedCalibration:
    """``found`` adjusted to more points; itself if it has enough, little is gained or a camera loses some.

    Args:
        found: a first solution (Note [What a first solution lacks]).
        keypoints: of its cameras, by name.
        limits: which observations stay.
        adjust: adjusts cameras and points together.
        workers: threads.
    """
    before = _counts(found)
    if before.min() >= ENOUGH:
        return found
    guided = guided_matches(keypoints, found.cameras, pixels=limits.pixels, workers=workers)
    graph = PosedGraph(
        {name: keypoints[name] for name in found.cameras},
        {pair: _geometry(rows) for pair, rows in guided.items() if len(rows)},
    )
    made = triangulated(graph, found.cameras, limits=limits)
    made = replace(found, points=made.points, observations=made.observations)
    joined = _joined(_confirmed(made), _confirmed(found))
    again = adjust(joined) if len(joined.observations) >= MIN_GAIN * before.sum() else found
    after = _counts(again)
    if again is found or (after < before).any():
        _log.info("Matching again gives a camera hardly more or fewer observations; the first solution stays.")
        return found
    _log.info("Matched again: %d observations in place of %d.", after.sum(), before.sum())
    return again


def _counts(found: SolvedCalibration) -> NDArray[np.intp]:
    """Observations ``[C]`` of each camera."""
    return np.bincount(found.observations.camera, minlength=len(found.cameras))


def _confirmed(found: SolvedCalibration) -> SolvedCalibration:
    """With the points alone that enough cameras see."""
    return chosen(found, (found.track_lengths() >= MIN_VIEWS)[found.observations.point])


def _geometry(rows: NDArray[np.uint32]) -> Any:
    pycolmap = pycolmap_module()
    geometry = pycolmap.TwoViewGeometry()
    geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
    geometry.inlier_matches = rows
    return geometry


def _joined(many: SolvedCalibration, few: SolvedCalibration) -> SolvedCalibration:
    """The points of ``many``, and those of ``few`` that share no keypoint with them."""
    one, two = many.observations, few.observations
    keys = np.concatenate([np.column_stack([seen.camera, seen.pixels]) for seen in (one, two)])
    _, key = np.unique(keys, axis=0, return_inverse=True)
    key = key.ravel()
    shared = np.zeros(len(few.points), bool)
    shared[two.point[np.isin(key[len(one) :], key[: len(one)])]] = True
    rest = chosen(few, ~shared[two.point])
    last = rest.observations
    observations = Observations(
        np.concatenate([one.point, last.point + len(many.points)]),
        *(np.concatenate([getattr(one, part), getattr(last, part)]) for part in ("camera", "pixels", "instant")),
    )
    return replace(many, points=np.concatenate([many.points, rest.points]), observations=observations)

# SPDX-License-Identifier: Apache-2.0
"""Points from matches of cameras whose poses are known."""

import os
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from structgstream.data.lenses import LensCamera
from structgstream.data.matching import Pair
from structgstream.preparation.calibration.colmap import colmap_camera, colmap_pose, pycolmap_module
from structgstream.preparation.calibration.keypoints import KeypointConfig, Keypoints, all_keypoints
from structgstream.preparation.calibration.matching import KeypointMatchConfig, agreeing_matches, all_matches
from structgstream.preparation.calibration.pictures import checked_pictures
from structgstream.preparation.calibration.view_graph import PairConfig, verified_pairs, write_database


@dataclass(frozen=True)
class TriangulationConfig:
    """Configuration of triangulation.

    Args:
        keypoints: what is found in a picture.
        matching: which keypoints match.
        pairs: which pairs of cameras are used.
        slack_degrees: largest angle of a match to its epipolar plane.
        pixels: largest reprojection error, for pictures of 1000 pixels on the longer side; never under 1.
        degrees: least angle between the rays of a point.
    """

    keypoints: KeypointConfig = field(default_factory=KeypointConfig)
    matching: KeypointMatchConfig = field(default_factory=KeypointMatchConfig)
    pairs: PairConfig = field(default_factory=PairConfig)
    slack_degrees: float = 0.4
    pixels: float = 3.0
    degrees: float = 1.5


@dataclass(frozen=True)
class PosedGraph:
    """Keypoints of cameras with known poses and the matches of them that agree with the poses and with each other."""

    keypoints: Mapping[str, Keypoints]
    matches: Mapping[Pair, NDArray[np.uint32]]
    geometries: Mapping[Pair, Any]


def posed_graph(
    pictures: Mapping[str, Sequence[NDArray[np.uint8]]],
    cameras: Mapping[str, LensCamera],
    *,
    masks: Mapping[str, Sequence[NDArray[np.bool_]]] | None,
    seed: int,
    config: TriangulationConfig,
) -> PosedGraph:
    """Keypoints and matches near the epipolar lines of the poses, verified pair by pair without them."""
    pycolmap_module()
    checked_pictures(pictures, masks, cameras)
    workers = max(1, min(len(pictures), os.cpu_count() or 1))
    shown = {name: pictures[name] for name in cameras}
    keypoints = all_keypoints(shown, masks, workers=workers, config=config.keypoints)
    matches = all_matches(keypoints, workers=workers, config=config.matching)
    near = agreeing_matches(keypoints, matches, cameras, degrees=config.slack_degrees)
    numbered = {name: colmap_camera(filmed, index) for index, (name, filmed) in enumerate(cameras.items(), 1)}
    geometries = verified_pairs(keypoints, near, numbered, seed=seed, workers=workers, config=config.pairs)
    return PosedGraph(keypoints, {pair: found.inlier_matches for pair, found in geometries.items()}, geometries)


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
    matches, geometries = {}, {}
    for pair, geometry in graph.geometries.items():
        kept = type(geometry)(geometry.todict())
        kept.inlier_matches = matches[pair] = graph.matches[pair][~dropped[pair]]
        geometries[pair] = kept
    return replace(graph, matches=matches, geometries=geometries)

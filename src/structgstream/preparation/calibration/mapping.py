# SPDX-License-Identifier: Apache-2.0
"""Models by COLMAP: verified pairs, mapping, bundle adjustment, and points of cameras whose poses are known.

Note [What a first solution lacks]
~~~~~~~~~~~~~~~~~~~~~~~~~~~~~~~~~~
The first matches are those that stand out among all keypoints of a picture. In bare rooms they are few and lie on
walls, at one depth, where a camera's place can be exchanged for its focal length. Points that three cameras confirm
near the epipolar lines of the first solution are more, and of more depths.
"""

import tempfile
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from structgstream.data.lenses import LensCamera
from structgstream.data.matching import Pair
from structgstream.geometry import Indices
from structgstream.preparation.calibration.bundle import MIN_DEGREES, chosen, inlier_pixels
from structgstream.preparation.calibration.colmap import colmap_cameras, colmap_pose, filmed_camera, pycolmap_module
from structgstream.preparation.calibration.keypoints import (
    Keypoints,
    agreeing_matches,
    all_keypoints,
    all_matches,
    guided_matches,
    of_each,
)
from structgstream.preparation.calibration.solved import Observations, SolvedCalibration

Matches = Mapping[Pair, NDArray[np.uint32]]

MIN_MATCHES = 20  # that agree
MIN_SHARE = 0.3
"""Smallest share of a pair's matches that agree. In rigs with repetitive walls nearly all pairs have some matches that
agree by chance; among those of 0.3 and more nearly all were right."""
MAX_TRIALS = 2000  # samples of the robust estimation


def verified_pairs(keypoints: Mapping[str, Keypoints], matches: Matches, cameras: Mapping[str, Any]) -> dict[Pair, Any]:
    """Two-view geometries of the pairs that pass, with the matches that agree; ``cameras`` are of pycolmap, with the
    focal lengths to begin with."""
    pycolmap = pycolmap_module()

    def estimate(pair: Pair) -> Any:
        one, two = (cameras[name] for name in pair)
        options = pycolmap.TwoViewGeometryOptions()
        options.min_num_inliers = MIN_MATCHES
        options.detect_watermark = False
        options.compute_relative_pose = True
        options.ransac.random_seed = 0
        options.ransac.max_num_trials = MAX_TRIALS
        options.ransac.max_error = inlier_pixels(max(one.width, one.height, two.width, two.height))
        return pycolmap.estimate_two_view_geometry(
            one, keypoints[pair[0]].pixels, two, keypoints[pair[1]].pixels, matches[pair], options
        )

    found = of_each([pair for pair, rows in matches.items() if len(rows) >= MIN_MATCHES], estimate)
    return {
        pair: geometry
        for pair, geometry in found.items()
        if len(geometry.inlier_matches) >= max(MIN_MATCHES, MIN_SHARE * len(matches[pair]))
    }


def write_database(
    path: Path, keypoints: Mapping[str, Keypoints], cameras: Mapping[str, Any], geometries: Mapping[Pair, Any]
) -> dict[str, int]:
    """A database of COLMAP's with an image per camera; returns the ids of the images.

    Cameras of one id are one camera with shared intrinsics.
    """
    pycolmap = pycolmap_module()
    number = {name: index for index, name in enumerate(keypoints, 1)}
    with pycolmap.Database.open(path) as database:
        for camera in {camera.camera_id: camera for camera in cameras.values()}.values():
            database.write_camera(camera, use_camera_id=True)
            rig = pycolmap.Rig(rig_id=camera.camera_id)
            rig.add_ref_sensor(camera.sensor_id)
            database.write_rig(rig, use_rig_id=True)
        for name, index in number.items():
            image = pycolmap.Image(name=name, camera_id=cameras[name].camera_id, image_id=index)
            database.write_image(image, use_image_id=True)
            frame = pycolmap.Frame(frame_id=index, rig_id=cameras[name].camera_id)
            frame.add_data_id(image.data_id)
            database.write_frame(frame, use_frame_id=True)
            database.write_keypoints(index, keypoints[name].pixels.astype(np.float32))
        for (one, two), geometry in geometries.items():
            database.write_matches(number[one], number[two], geometry.inlier_matches)
            database.write_two_view_geometry(number[one], number[two], geometry)
    return number


Mapper = Literal["incremental", "global"]
HUBER_PIXELS = 1.0


def mapped(database: Path, *, mapper: Mapper, stills: Collection[str]) -> Any | None:
    """The largest model (:func:`size_of`) that a mapper finds, None without one; one thread, so it is repeatable.

    Focal lengths and distortion are estimated; principal points stay (Note [Alike lenses])."""
    pycolmap = pycolmap_module()
    folder = database.parent / mapper
    folder.mkdir()
    pycolmap.set_random_seed(0)
    if mapper == "incremental":
        found = pycolmap.incremental_mapping(database, folder, folder, _incremental_options())
    else:
        found = pycolmap.global_mapping(database, folder, folder, _global_options())
    return max(found.values(), key=lambda model: size_of(model, stills), default=None)


def placed_in(model: Any) -> list[str]:
    """Names of the cameras that a model places."""
    return [model.image(number).name for number in model.reg_image_ids()]


def size_of(model: Any, stills: Collection[str]) -> tuple[int, int, int]:
    """How large a model is: images of still cameras, all images, observations."""
    names = placed_in(model)
    return sum(name in stills for name in names), len(names), model.compute_num_observations()


def _repeatable_options() -> Any:
    options = pycolmap_module().IncrementalPipelineOptions()
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = 0
    options.num_threads = options.mapper.num_threads = 1
    options.extract_colors = False
    return options


def _incremental_options() -> Any:
    options = _repeatable_options()
    options.min_model_size = 2
    options.ba_refine_focal_length = options.mapper.abs_pose_refine_focal_length = True
    options.ba_refine_extra_params = options.mapper.abs_pose_refine_extra_params = True
    # A rig has few cameras with wide baselines, so each has fewer matches than a photo collection's.
    options.mapper.init_min_num_inliers = 40
    options.mapper.init_min_tri_angle = 8.0
    options.mapper.abs_pose_min_num_inliers = 15
    options.mapper.max_reg_trials = 10
    return options


def _global_options() -> Any:
    options = pycolmap_module().GlobalPipelineOptions()
    options.random_seed = options.mapper.random_seed = 0
    options.num_threads = options.mapper.num_threads = 1
    options.mapper.global_positioning.use_gpu = False
    options.mapper.bundle_adjustment.ceres.use_gpu = False
    options.mapper.bundle_adjustment.refine_focal_length = True
    options.mapper.bundle_adjustment.refine_extra_params = True
    return options


def adjust(model: Any, *, lens: bool = True) -> None:
    """Bundle adjustment of ``model`` in place, with Huber's loss: poses, points, focal lengths and, if ``lens``,
    distortion."""
    pycolmap = pycolmap_module()
    config = pycolmap.BundleAdjustmentConfig()
    for image in model.reg_image_ids():
        config.add_image(image)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length, options.refine_principal_point = True, False
    options.refine_extra_params = lens
    options.refine_rig_from_world = options.refine_sensor_from_rig = True
    options.min_track_length = 0
    options.ceres.use_gpu = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.HUBER
    options.ceres.loss_function_scale = HUBER_PIXELS
    options.ceres.solver_options.num_threads = 1
    options.ceres.solver_options.function_tolerance = 1e-9
    options.ceres.solver_options.max_num_iterations = 200
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()


def filter_model(model: Any, *, pixels: float) -> None:
    """Removes observations with a larger reprojection error, and points whose rays have too small an angle."""
    pycolmap_module().ObservationManager(model).filter_all_points3D(pixels, MIN_DEGREES)


def cameras_of(model: Any) -> dict[str, LensCamera]:
    """The placed cameras by name."""
    images = (model.image(number) for number in sorted(model.reg_image_ids()))
    return {image.name: filmed_camera(image.camera, image.cam_from_world()) for image in images}


def observed(model: Any, keypoints: Mapping[str, Keypoints], names: Iterable[str]) -> tuple[np.ndarray, Observations]:
    """The points ``[P, 3]`` of a model and where they were seen; cameras are numbered in the order of ``names``."""
    order = {name: index for index, name in enumerate(names)}
    numbers = sorted(model.point3D_ids())
    points = np.array([model.point3D(number).xyz for number in numbers]).reshape(-1, 3)
    rows: list[tuple[int, int, int]] = []
    images = {number: model.image(number).name for number in model.reg_image_ids()}
    for index, number in enumerate(numbers):
        for element in model.point3D(number).track.elements:
            rows.append((index, order[images[element.image_id]], element.point2D_idx))
    table = np.array(rows, np.intp).reshape(-1, 3)
    pixels, instants = np.empty((len(table), 2)), np.empty(len(table), np.intp)
    for name, index in order.items():
        own = table[:, 1] == index
        which = table[own, 2]
        pixels[own] = keypoints[name].pixels[which]
        instants[own] = keypoints[name].seen[which].argmax(1)
    return points, Observations(table[:, 0], table[:, 1], pixels, instants)


SLACK_DEGREES = 0.4  # largest angle between a ray and its point while points are triangulated
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
    keypoints = all_keypoints({name: pictures[name] for name in cameras})
    near = agreeing_matches(keypoints, all_matches(keypoints), cameras, degrees=slack_degrees)
    return PosedGraph(keypoints, verified_pairs(keypoints, near, colmap_cameras(cameras)))


def triangulated(graph: PosedGraph, cameras: Mapping[str, LensCamera], *, pixels: float) -> SolvedCalibration:
    """The cameras with the points of the graph's matches, without observations that are more than ``pixels`` off."""
    model = posed_model(graph, cameras, pixels=pixels, slack_degrees=SLACK_DEGREES)
    filter_model(model, pixels=pixels)
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
    numbered = colmap_cameras(cameras, models)
    model = pycolmap.Reconstruction()
    for camera in numbered.values():
        model.add_camera_with_trivial_rig(camera)
    options = _repeatable_options()
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
    pixels: float,
    adjust: Callable[[SolvedCalibration], SolvedCalibration],
) -> SolvedCalibration:
    """The first solution ``found`` adjusted to more points (Note [What a first solution lacks]); itself if it has
    enough, little is gained or a camera loses some. Observations may be ``pixels`` off; ``adjust`` adjusts cameras and
    points together."""
    before = _counts(found)
    if before.min() >= ENOUGH:
        return found
    pycolmap, geometries = pycolmap_module(), {}
    for pair, rows in guided_matches(keypoints, found.cameras, pixels=pixels).items():
        if len(rows):
            geometries[pair] = pycolmap.TwoViewGeometry()
            geometries[pair].config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
            geometries[pair].inlier_matches = rows
    graph = PosedGraph({name: keypoints[name] for name in found.cameras}, geometries)
    made = triangulated(graph, found.cameras, pixels=pixels)
    made = replace(found, points=made.points, observations=made.observations)
    joined = _joined(_confirmed(made), _confirmed(found))
    if len(joined.observations) < MIN_GAIN * before.sum():
        return found
    again = adjust(joined)
    return found if (_counts(again) < before).any() else again


def _counts(found: SolvedCalibration) -> Indices:
    """Observations ``[C]`` of each camera."""
    return np.bincount(found.observations.camera, minlength=len(found.cameras))


def _confirmed(found: SolvedCalibration) -> SolvedCalibration:
    """With the points alone that enough cameras see."""
    return chosen(found, (found.track_lengths() >= MIN_VIEWS)[found.observations.point])


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

# SPDX-License-Identifier: Apache-2.0
"""A model from matches, by COLMAP: pairs that agree with one geometry, mapping, and bundle adjustment."""

from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from structgstream.data.lenses import LensCamera
from structgstream.data.matching import Pair
from structgstream.preparation.calibration.colmap import filmed_camera, pycolmap_module
from structgstream.preparation.calibration.keypoints import Keypoints
from structgstream.preparation.calibration.solved import Observations

Matches = Mapping[Pair, NDArray[np.uint32]]


MAX_PIXELS = 3.0  # epipolar distance of a match, for pictures of 1000 pixels on the longer side; never under 1
MIN_MATCHES = 20  # that agree
MIN_SHARE = 0.3
"""Smallest share of a pair's matches that agree. In rigs with repetitive walls nearly all pairs have some matches that
agree by chance; among those of 0.3 and more nearly all were right."""
MAX_TRIALS = 2000  # samples of the robust estimation


def verified_pairs(
    keypoints: Mapping[str, Keypoints],
    matches: Matches,
    cameras: Mapping[str, Any],
    *,
    workers: int,
) -> dict[Pair, Any]:
    """Two-view geometries of the pairs that pass, with the matches that agree.

    Args:
        cameras: of pycolmap, with the focal lengths to begin with.
    """
    pycolmap = pycolmap_module()

    def estimate(pair: Pair) -> Any:
        one, two = (cameras[name] for name in pair)
        options = pycolmap.TwoViewGeometryOptions()
        options.min_num_inliers = MIN_MATCHES
        options.detect_watermark = False
        options.compute_relative_pose = True
        options.ransac.random_seed = 0
        options.ransac.max_num_trials = MAX_TRIALS
        options.ransac.max_error = max(1.0, MAX_PIXELS * max(one.width, one.height, two.width, two.height) / 1000)
        return pycolmap.estimate_two_view_geometry(
            one, keypoints[pair[0]].pixels, two, keypoints[pair[1]].pixels, matches[pair], options
        )

    pairs = [pair for pair, found in matches.items() if len(found) >= MIN_MATCHES]
    with ThreadPoolExecutor(workers) as pool:
        found = dict(zip(pairs, pool.map(estimate, pairs), strict=True))
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


def mapped(database: Path, *, mapper: Mapper) -> Any | None:
    """The model of the most images that a mapper finds, None without one; one thread, so it is repeatable.

    Focal lengths and distortion are estimated; principal points stay (Note [Alike lenses])."""
    pycolmap = pycolmap_module()
    folder = database.parent / mapper
    folder.mkdir()
    pycolmap.set_random_seed(0)
    if mapper == "incremental":
        found = pycolmap.incremental_mapping(database, folder, folder, _incremental_options())
    else:
        found = pycolmap.global_mapping(database, folder, folder, _global_options())
    return max(found.values(), key=size_of, default=None)


def size_of(model: Any) -> tuple[int, int]:
    """How large a model is: images, observations."""
    return model.num_reg_images(), model.compute_num_observations()


def _incremental_options() -> Any:
    options = pycolmap_module().IncrementalPipelineOptions()
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = 0
    options.num_threads = options.mapper.num_threads = 1
    options.extract_colors = False
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


def filtered(model: Any, *, pixels: float, degrees: float) -> int:
    """Removes observations with a larger reprojection error and points with a smaller angle; returns how many."""
    pycolmap = pycolmap_module()
    return pycolmap.ObservationManager(model).filter_all_points3D(pixels, degrees)


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

# SPDX-License-Identifier: Apache-2.0
"""A model from a view graph: incremental mapping, global mapping and bundle adjustment by COLMAP."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np

from structgstream.data.lenses import LensCamera
from structgstream.preparation.calibration.colmap import filmed_camera, pycolmap_module
from structgstream.preparation.calibration.keypoints import Keypoints
from structgstream.preparation.calibration.solved import Observations

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

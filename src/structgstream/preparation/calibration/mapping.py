# SPDX-License-Identifier: Apache-2.0
"""A model from a view graph: incremental mapping, global mapping and bundle adjustment by COLMAP."""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from structgstream.data.lenses import LensCamera
from structgstream.preparation.calibration.colmap import filmed_camera, pycolmap_module
from structgstream.preparation.calibration.keypoints import Keypoints
from structgstream.preparation.calibration.solved import Observations

Mapper = Literal["incremental", "global"]
HUBER_PIXELS = 1.0


@dataclass(frozen=True)
class Freedom:
    """What of the intrinsics is estimated.

    Args:
        focal: focal lengths.
        center: principal points, in :func:`adjust` only, and kept near the pictures' centres (Note [Principal points]).
        lens: distortion.
    """

    focal: bool = True
    center: bool = True
    lens: bool = True

    @property
    def any(self) -> bool:
        """Whether anything but poses and points is free."""
        return self.focal or self.center or self.lens


def mapped(database: Path, *, mapper: Mapper, freedom: Freedom, fixed: frozenset[int]) -> Any | None:
    """The model of the most images that a mapper finds, None without one; one thread, so it is repeatable."""
    pycolmap = pycolmap_module()
    folder = database.parent / mapper
    folder.mkdir()
    pycolmap.set_random_seed(0)
    if mapper == "incremental":
        found = pycolmap.incremental_mapping(database, folder, folder, _incremental_options(freedom, fixed))
    else:
        found = pycolmap.global_mapping(database, folder, folder, _global_options(freedom))
    return max(found.values(), key=size_of, default=None)


def size_of(model: Any) -> tuple[int, int]:
    """How large a model is: images, observations."""
    return model.num_reg_images(), model.compute_num_observations()


def _incremental_options(freedom: Freedom, fixed: frozenset[int]) -> Any:
    options = pycolmap_module().IncrementalPipelineOptions()
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = 0
    options.num_threads = options.mapper.num_threads = 1
    options.extract_colors = False
    options.min_model_size = 2
    options.ba_refine_focal_length = options.mapper.abs_pose_refine_focal_length = freedom.focal
    options.ba_refine_extra_params = options.mapper.abs_pose_refine_extra_params = freedom.lens
    options.constant_cameras = options.mapper.constant_cameras = set(fixed)
    # A rig has few cameras with wide baselines, so each has fewer matches than a photo collection's.
    options.mapper.init_min_num_inliers = 40
    options.mapper.init_min_tri_angle = 8.0
    options.mapper.abs_pose_min_num_inliers = 15
    options.mapper.max_reg_trials = 10
    return options


def _global_options(freedom: Freedom) -> Any:
    options = pycolmap_module().GlobalPipelineOptions()
    options.random_seed = options.mapper.random_seed = 0
    options.num_threads = options.mapper.num_threads = 1
    options.mapper.global_positioning.use_gpu = False
    options.mapper.bundle_adjustment.ceres.use_gpu = False
    options.mapper.bundle_adjustment.refine_focal_length = freedom.focal
    options.mapper.bundle_adjustment.refine_extra_params = freedom.lens
    return options


def adjust(
    model: Any,
    *,
    freedom: Freedom,
    fixed: frozenset[int] = frozenset(),
    constant_points: bool = False,
) -> None:
    """Bundle adjustment of ``model`` in place, with Huber's loss.

    Args:
        fixed: ids of cameras whose intrinsics stay.
        constant_points: whether points stay.
    """
    pycolmap = pycolmap_module()
    config = pycolmap.BundleAdjustmentConfig()
    for image in model.reg_image_ids():
        config.add_image(image)
    for camera in model.cameras if not freedom.any else fixed:
        config.set_constant_cam_intrinsics(camera)
    if constant_points:
        for point in model.point3D_ids():
            config.add_constant_point(point)
    else:
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length, options.refine_principal_point = freedom.focal, freedom.center
    options.refine_extra_params = freedom.lens
    options.refine_rig_from_world = options.refine_sensor_from_rig = True
    options.min_track_length = 0
    options.ceres.use_gpu = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.HUBER
    options.ceres.loss_function_scale = HUBER_PIXELS
    options.ceres.solver_options.num_threads = 1
    options.ceres.solver_options.function_tolerance = 1e-9
    options.ceres.solver_options.max_num_iterations = 200
    with _held_centers(model, config, hold=freedom.center and not constant_points):
        pycolmap.create_default_bundle_adjuster(options, config, model).solve()


@contextmanager
def _held_centers(model: Any, config: Any, *, hold: bool) -> Iterator[None]:
    """Holds the principal points of a model near the centres of their pictures while it is adjusted.

    Note [Principal points]: cameras that surround a scene hardly distinguish a principal point from a rotation, so
    freed ones wander off, and focal lengths with them. A point on the optical axis is seen in the principal point
    whatever focal length and lens are. So each camera gets another picture, of a fixed pose, in which such a point is
    seen in the picture's centre: one observation more, which hundreds of others overrule where they know better.
    """
    free = sorted(set(model.cameras) - set(config.constant_cam_intrinsics))
    if not hold or not free:
        yield
        return
    pycolmap = pycolmap_module()
    axis = model.add_point3D(np.array([0.0, 0.0, 1.0]), pycolmap.Track(), np.zeros(3, np.uint8))
    config.add_constant_point(axis)
    rigs = {rig.ref_sensor_id.id: number for number, rig in model.rigs.items()}
    image_id, frame_id = max(model.images), max(model.frames)
    frames = []
    for number in free:
        camera, image_id, frame_id = model.camera(number), image_id + 1, frame_id + 1
        frame = pycolmap.Frame(frame_id=frame_id, rig_id=rigs[number], rig_from_world=pycolmap.Rigid3d())
        frame.add_data_id(pycolmap.data_t(camera.sensor_id, image_id))
        model.add_frame(frame)
        image = pycolmap.Image(name=f"center {number}", camera_id=number, image_id=image_id, frame_id=frame_id)
        center = np.array([camera.width / 2, camera.height / 2])
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(center, axis)] * 2)  # a track has at least two
        model.add_image(image)
        model.register_frame(frame_id)
        for index in range(2):
            model.point3D(axis).track.add_element(image_id, index)
        config.add_image(image_id)
        config.set_constant_rig_from_world_pose(frame_id)
        frames.append(frame_id)
    yield
    model.delete_point3D(axis)
    for frame_id in frames:
        model.deregister_frame(frame_id)


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

# SPDX-License-Identifier: Apache-2.0
"""Cameras, lenses and their poses in metres from a ChArUco board that is shown around.

Views of the board are a model of COLMAP's in which the board is the world and the rig moves before it. The cameras are
the sensors of one rig, an instant is a frame of it: a picture's pose is the camera's in the rig times the rig's before
the board. So the poses that still cameras share over all instants are shared in the adjustment, and the board's
corners, which are known, fix its scale.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from structgstream.data.arrays import Floats
from structgstream.data.calibration import listed
from structgstream.data.lenses import LensCamera
from structgstream.errors import CalibrationError
from structgstream.preparation.calibration.adjustment import cameras_in, estimated, posed_problem
from structgstream.preparation.calibration.board import Board, Sighting, board_sightings
from structgstream.preparation.calibration.bundle import BodyObservations, Parameters
from structgstream.preparation.calibration.colmap import (
    LensModel,
    colmap_camera,
    colmap_pose,
    filmed_camera,
    guessed_camera,
    pycolmap_module,
)
from structgstream.preparation.calibration.lens_terms import ACROSS, ASPECT, DISTORTION, DOWN, FOCAL
from structgstream.preparation.calibration.mapping import Freedom, adjust
from structgstream.preparation.calibration.solved import Observations, SolvedCalibration

Sightings = Mapping[str, Sequence[Sighting]]


def board_model(
    board: Board,
    sightings: Sightings,
    cameras: Mapping[str, Any],
    sensors: Mapping[str, Floats],
    rig_poses: Mapping[int, Floats],
) -> Any:
    """The model of all sightings.

    Args:
        cameras: of pycolmap, with the ids 1, 2, ... in the order of the names.
        sensors: rig-to-camera matrices ``[4, 4]``; the first camera is the rig's reference, its matrix the identity.
        rig_poses: instant to the board-to-rig matrix ``[4, 4]``.
    """
    pycolmap = pycolmap_module()
    model = pycolmap.Reconstruction()
    rig = pycolmap.Rig(rig_id=1)
    for name, camera in cameras.items():
        model.add_camera(camera)
        if rig.num_sensors() == 0:
            rig.add_ref_sensor(camera.sensor_id)
        else:
            rig.add_sensor(camera.sensor_id, colmap_pose(sensors[name]))
    model.add_rig(rig)
    black = np.zeros(3, np.uint8)
    known = board.corners
    corners = {index: model.add_point3D(known[index], pycolmap.Track(), black) for index in _repeated(sightings)}
    images: list[tuple[int, str, Sighting]] = []
    for instant, pose in rig_poses.items():
        frame = pycolmap.Frame(frame_id=instant + 1, rig_id=1)
        for name, own_sightings in sightings.items():
            for sighting in (sighting for sighting in own_sightings if sighting.instant == instant):
                images.append((len(images) + 1, name, sighting))
                frame.add_data_id(pycolmap.data_t(cameras[name].sensor_id, len(images)))
        frame.rig_from_world = colmap_pose(pose)
        model.add_frame(frame)
    for number, name, sighting in images:
        image = pycolmap.Image(
            name=f"{name}/{sighting.instant}",
            camera_id=cameras[name].camera_id,
            image_id=number,
            frame_id=sighting.instant + 1,
        )
        seen = [(pixel, corners[corner]) for pixel, corner in _of_points(sighting, corners)]
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(pixel, point) for pixel, point in seen])
        model.add_image(image)
    for instant in rig_poses:
        model.register_frame(instant + 1)
    for number, _, sighting in images:
        for index, (_, corner) in enumerate(_of_points(sighting, corners)):
            model.point3D(corners[corner]).track.add_element(number, index)
    return model


def _repeated(sightings: Sightings) -> list[int]:
    """The corners that have two observations or more: COLMAP adjusts no others."""
    seen = [sighting.corners for own_sightings in sightings.values() for sighting in own_sightings]
    corners, counts = np.unique(np.concatenate(seen), return_counts=True)
    return [int(corner) for corner in corners[counts > 1]]


def _of_points(sighting: Sighting, points: Mapping[int, int]) -> list[tuple[Floats, int]]:
    pairs = zip(sighting.pixels, sighting.corners.tolist(), strict=True)
    return [(pixel, corner) for pixel, corner in pairs if corner in points]


def sensor_poses(model: Any, cameras: Mapping[str, Any]) -> dict[str, Floats]:
    """Rig-to-camera matrices ``[4, 4]``."""
    rig = model.rig(1)
    return {
        name: np.eye(4) if rig.is_ref_sensor(camera.sensor_id) else matrix(rig.sensor_from_rig(camera.sensor_id))
        for name, camera in cameras.items()
    }


def rig_poses(model: Any) -> dict[int, Floats]:
    """Board-to-rig matrices ``[4, 4]`` by instant."""
    return {number - 1: matrix(model.frame(number).rig_from_world) for number in sorted(model.reg_frame_ids())}


def matrix(pose: Any) -> Floats:
    """A rigid motion of pycolmap as ``[4, 4]``."""
    return np.vstack([np.array(pose.matrix()), [0.0, 0.0, 0.0, 1.0]])


FIELDS_OF_VIEW: Mapping[LensModel, tuple[float, ...]] = {
    "pinhole": (30.0, 50.0, 70.0, 90.0),
    "radial": (30.0, 50.0, 70.0, 90.0),
    "opencv": (30.0, 50.0, 70.0, 90.0),
    "brown": (30.0, 50.0, 70.0, 90.0),
    "fisheye": (60.0, 90.0, 120.0, 150.0, 175.0),
}
MAX_SIGHTINGS_ALONE = 24
POSE_PIXELS = 0.02  # of the longer side: coarse, since the lens is not known yet
OUTLIER_PIXELS = 2.0


def solve_board(
    pictures: Mapping[str, Sequence[NDArray[np.uint8]]],
    board: Board,
    *,
    lens: LensModel = "opencv",
    known: Mapping[str, LensCamera] | None = None,
) -> SolvedCalibration:
    """Poses, intrinsics and lenses from pictures of ``board`` at many instants.

    The lens of each camera is estimated from its own sightings, poses between cameras from the instants that they
    share, and all of them, with the board's pose at each instant, are then adjusted together, at last with what alike
    lenses share (lens_prior.py, Note [Alike lenses]).

    Args:
        pictures: camera name to pictures ``[H, W, 3]`` of the same instants for all cameras.
        lens: which distortion is estimated.
        known: cameras whose intrinsics and lens are known and stay; their poses are not read.

    Returns:
        the calibration in metres, in the axes of the first camera; the points are the board's corners at each instant.

    Raises:
        CalibrationError: a camera that does not show the board well enough, or at no instant at which it connects to
            the others; another board than given.
        MissingExtraError: pycolmap or cv2 is not installed.
    """
    pycolmap_module()
    sightings = board_sightings(pictures, board)
    known = known or {}
    views = {}
    for number, (name, shots) in enumerate(pictures.items(), 1):
        size = shots[0].shape[1], shots[0].shape[0]
        if name in known:
            starts = [colmap_camera(known[name], number)]
        else:
            starts = [guessed_camera(lens, number, size, degrees) for degrees in FIELDS_OF_VIEW[lens]]
        views[name] = _own_view(name, sightings[name], board, starts, fixed=name in known)
    sensors = _connected_sensors(views)
    poses = _rig_poses(views, sensors, sightings)
    cameras = {name: view.camera for name, view in views.items()}
    fixed = frozenset(cameras[name].camera_id for name in known)
    free = Freedom(*[len(known) < len(pictures)] * 3)
    filmed = _filmed(cameras, sensors)
    inliers: Sightings = {name: [s for s in sightings[name] if s.instant in view.poses] for name, view in views.items()}
    for _ in range(2):
        model = board_model(board, inliers, cameras, sensors, poses)
        adjust(model, freedom=free, fixed=fixed, constant_points=True)
        cameras = {name: model.camera(camera.camera_id) for name, camera in cameras.items()}
        sensors, poses = sensor_poses(model, cameras), rig_poses(model)
        filmed = _filmed(cameras, sensors)
        inliers = _without_outliers(inliers, _solved(board, inliers, filmed, poses))
    filmed, poses = adjust_board(board, inliers, filmed, poses, lens=lens, known=frozenset(known))
    return _solved(board, inliers, filmed, poses)


@dataclass(frozen=True)
class _View:
    """A camera as its own sightings give it: ``camera`` of pycolmap and board-to-camera matrices by instant."""

    camera: Any
    poses: Mapping[int, Floats]


def _own_view(
    name: str, own_sightings: Sequence[Sighting], board: Board, starts: Sequence[Any], *, fixed: bool
) -> _View:
    """Intrinsics from the best start, and a pose for each sighting that agrees with them."""
    chosen = sorted(own_sightings, key=lambda sighting: (-len(sighting.corners), sighting.instant))[
        : 2 * MAX_SIGHTINGS_ALONE
    ]
    chosen = sorted(chosen, key=lambda sighting: sighting.instant)
    picks = np.linspace(0, len(chosen) - 1, min(len(chosen), MAX_SIGHTINGS_ALONE)).round().astype(int)
    sample = [chosen[index] for index in picks]
    best: tuple[float, Any] | None = None
    for camera in starts:
        poses = _poses(camera, sample, board)
        if len(poses) < max(3, len(sample) // 2):
            continue
        if not fixed:
            seen = {name: [sighting for sighting in sample if sighting.instant in poses]}
            model = board_model(board, seen, {name: camera}, {name: np.eye(4)}, poses)
            adjust(model, freedom=Freedom(), constant_points=True)
            camera = model.camera(camera.camera_id)
            model.update_point_3d_errors()
        error = _misfit(camera, sample, board)
        if best is None or error < best[0]:
            best = error, camera
    if best is not None:
        poses = _poses(best[1], own_sightings, board, share=0.005)
        if len(poses) >= 3:
            return _View(best[1], poses)
    raise CalibrationError(
        f"The lens of camera {name!r} cannot be estimated from its {len(own_sightings)} sightings of the board "
        f"({board.text}): show the board whole, flat, and tilted in several directions, or choose the lens model that "
        "the camera has (fisheye for very wide ones)."
    )


def _poses(
    camera: Any, own_sightings: Sequence[Sighting], board: Board, *, share: float = POSE_PIXELS
) -> dict[int, Floats]:
    """Board-to-camera matrices by instant, of the sightings of which most corners agree."""
    pycolmap = pycolmap_module()
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = max(2.0, share * max(camera.width, camera.height))
    options.ransac.random_seed = 0
    found = {}
    for sighting in own_sightings:
        result = pycolmap.estimate_and_refine_absolute_pose(
            sighting.pixels, board.corners[sighting.corners], camera, options
        )
        if result is not None and result["num_inliers"] >= 0.7 * len(sighting.corners):
            found[sighting.instant] = matrix(result["cam_from_world"])
    return found


def _misfit(camera: Any, own_sightings: Sequence[Sighting], board: Board) -> float:
    """Median over the sightings of the median reprojection error, pixels; infinite for one without a pose."""
    errors = []
    poses = _poses(camera, own_sightings, board)
    for sighting in own_sightings:
        if sighting.instant not in poses:
            errors.append(np.inf)
            continue
        pose = poses[sighting.instant]
        local = board.corners[sighting.corners] @ pose[:3, :3].T + pose[:3, 3]
        errors.append(float(np.median(np.linalg.norm(camera.img_from_cam(local) - sighting.pixels, axis=1))))
    return float(np.median(errors))


def _connected_sensors(views: Mapping[str, _View]) -> dict[str, Floats]:
    """Rig-to-camera matrices along the pairs that share most instants, from the first camera."""
    names = list(views)
    placed = {names[0]: np.eye(4)}
    while len(placed) < len(names):
        links = [
            (len(views[new].poses.keys() & views[old].poses.keys()), old, new)
            for old in placed
            for new in names
            if new not in placed
        ]
        shared, old, new = max(links, key=lambda link: link[0])
        if shared == 0:
            left = [name for name in names if name not in placed]
            raise CalibrationError(
                f"{listed(left)} never show the board at an instant at which {listed(placed)} show it, too: carry it "
                "slowly through where neighbouring cameras both see it, and check that the videos are in step."
            )
        instants = sorted(views[new].poses.keys() & views[old].poses.keys())
        moves = [views[new].poses[t] @ np.linalg.inv(views[old].poses[t]) for t in instants]
        placed[new] = _middle(moves) @ placed[old]
    return {name: placed[name] for name in names}


def _middle(moves: Sequence[Floats]) -> Floats:
    """The rigid motion that is closest to the others: one bad pose does not move it."""
    size = float(np.median([np.linalg.norm(move[:3, 3]) for move in moves])) or 1.0
    stack = np.stack(moves)
    stack[:, :3, 3] /= size
    distances = np.linalg.norm(stack[:, None] - stack[None], axis=(2, 3)).sum(1)
    return moves[int(np.argmin(distances))]


def _rig_poses(views: Mapping[str, _View], sensors: Mapping[str, Floats], sightings: Sightings) -> dict[int, Floats]:
    """Board-to-rig matrices by instant, from the camera that sees most corners."""
    best: dict[int, tuple[int, Floats]] = {}
    for name, view in views.items():
        counts = {sighting.instant: len(sighting.corners) for sighting in sightings[name]}
        for instant, pose in view.poses.items():
            if counts[instant] > best.get(instant, (0, None))[0]:
                best[instant] = counts[instant], np.linalg.inv(sensors[name]) @ pose
    return {instant: best[instant][1] for instant in sorted(best)}


def _filmed(cameras: Mapping[str, Any], sensors: Mapping[str, Floats]) -> dict[str, LensCamera]:
    pose = pycolmap_module().Rigid3d
    return {name: filmed_camera(camera, pose(sensors[name][:3])) for name, camera in cameras.items()}


def _solved(
    board: Board, sightings: Sightings, filmed: Mapping[str, LensCamera], poses: Mapping[int, Floats]
) -> SolvedCalibration:
    number = {instant: index for index, instant in enumerate(poses)}
    corners = board.corners
    points = [corners @ pose[:3, :3].T + pose[:3, 3] for pose in poses.values()]
    rows = [
        (number[sighting.instant] * len(corners) + corner, index, sighting.instant, *pixel)
        for index, name in enumerate(filmed)
        for sighting in sightings[name]
        for corner, pixel in zip(sighting.corners, sighting.pixels, strict=True)
    ]
    table = np.array(rows, np.float64).reshape(-1, 5)
    which, owner, instant = (table[:, column].astype(np.intp) for column in range(3))
    seen, point = np.unique(which, return_inverse=True)
    observations = Observations(point.astype(np.intp), owner, table[:, 3:], instant)
    return SolvedCalibration(dict(filmed), np.concatenate(points)[seen], observations, metres=True)


def _without_outliers(sightings: Sightings, solved: SolvedCalibration) -> Sightings:
    """Sightings without the corners that are far from where they should be."""
    errors = solved.errors()
    limit = max(OUTLIER_PIXELS, 6 * float(np.nanmedian(errors)))
    good = iter((errors <= limit).tolist())
    inliers: dict[str, list[Sighting]] = {}
    for name, own_sightings in sightings.items():
        inliers[name] = []
        for sighting in own_sightings:
            inside = np.array([next(good) for _ in sighting.corners], bool)
            if inside.sum() >= 4:
                inliers[name].append(
                    replace(sighting, corners=sighting.corners[inside], pixels=sighting.pixels[inside])
                )
    return inliers


def adjust_board(
    board: Board,
    sightings: Sightings,
    cameras: Mapping[str, LensCamera],
    poses: Mapping[int, Floats],
    *,
    lens: LensModel,
    known: frozenset[str],
) -> tuple[dict[str, LensCamera], dict[int, Floats]]:
    """Cameras and board-to-world poses ``[4, 4]`` by instant, adjusted together; the first camera is the world.

    Args:
        lens: which distortion is estimated.
        known: cameras whose intrinsics and lens stay.
    """
    number = {instant: index for index, instant in enumerate(poses)}
    seen = [(index, sighting) for index, name in enumerate(cameras) for sighting in sightings[name]]
    counts = [len(sighting.corners) for _, sighting in seen]
    observations = BodyObservations(
        np.repeat([index for index, _ in seen], counts).astype(np.intp),
        np.repeat([number[sighting.instant] for _, sighting in seen], counts).astype(np.intp),
        np.concatenate([board.corners[sighting.corners] for _, sighting in seen]),
        np.concatenate([sighting.pixels for _, sighting in seen]),
    )
    stack = np.stack(list(poses.values()))
    bundle, parameters = posed_problem(
        list(cameras.values()),
        observations,
        (stack[:, :3, :3], stack[:, :3, 3]),
        lens=np.arange(len(cameras)),
        free=(FOCAL, ASPECT, ACROSS, DOWN, *DISTORTION[lens]),
        fixed=np.array([name in known for name in cameras]),
        rotating=True,
    )
    bundle, parameters = estimated(bundle, parameters)
    parameters = _from_first(parameters)
    return cameras_in(parameters, cameras, bundle.lens), dict(
        zip(poses, _matrices(parameters.body_rotations, parameters.body_positions), strict=True)
    )


def _from_first(parameters: Parameters) -> Parameters:
    """In the axes of the first camera."""
    turn, move = parameters.rotations[0], parameters.translations[0]
    rotations = parameters.rotations @ turn.T
    translations = parameters.translations - rotations @ move
    rotations[0], translations[0] = np.eye(3), 0.0  # exactly
    return replace(
        parameters,
        rotations=rotations,
        translations=translations,
        body_rotations=turn @ parameters.body_rotations,
        body_positions=parameters.body_positions @ turn.T + move,
    )


def _matrices(body_rotations: Floats, body_positions: Floats) -> Floats:
    found = np.tile(np.eye(4), (len(body_rotations), 1, 1))
    found[:, :3, :3], found[:, :3, 3] = body_rotations, body_positions
    return found

# SPDX-License-Identifier: Apache-2.0
"""Cameras, lenses and their poses in metres from a ChArUco board that is shown around.

The board is a body with one pose an instant, the cameras have one pose for all instants, and the board's corners, which
are known, fix the scale.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from structgstream.data.calibration import listed, rigid
from structgstream.data.lenses import LensCamera
from structgstream.errors import CalibrationError
from structgstream.geometry import Floats
from structgstream.preparation.calibration.board import Board, Sighting, board_sightings
from structgstream.preparation.calibration.bundle import (
    BodyObservations,
    Parameters,
    cameras_in,
    estimated,
    posed_problem,
    solved,
)
from structgstream.preparation.calibration.colmap import colmap_camera, filmed_camera, guessed_camera, pycolmap_module
from structgstream.preparation.calibration.lens_terms import ACROSS, ASPECT, DISTORTION, DOWN, FOCAL, LensModel
from structgstream.preparation.calibration.solved import Observations, SolvedCalibration

Sightings = Mapping[str, Sequence[Sighting]]
FIELDS_OF_VIEW, FISHEYE_FIELDS_OF_VIEW = (30.0, 50.0, 70.0, 90.0), (60.0, 90.0, 120.0, 150.0, 175.0)
MAX_SIGHTINGS_ALONE = 24
POSE_PIXELS = 0.02  # of the longer side: coarse, since the lens is not known yet
OUTLIER_PIXELS = 2.0
ROUGH_STEPS = 12


def solve_board(
    pictures: Mapping[str, Sequence[NDArray[np.uint8]]],
    board: Board,
    *,
    lens: LensModel = "opencv",
) -> SolvedCalibration:
    """Poses, intrinsics and lenses from pictures of ``board`` at many instants, in metres and the axes of the first
    camera.

    The lens of each camera is estimated from its own sightings, poses between cameras from the instants that they
    share, and all of them, with the board's pose at each instant, are then adjusted together; the last time the prior
    that similar lenses share (lens_terms.py, Note [Alike lenses]) is estimated, too. The points are the board's corners
    at each instant.

    Args:
        pictures: camera name to pictures ``[H, W, 3]`` of the same instants for all cameras.
        lens: which distortion is estimated.

    Raises:
        CalibrationError: a camera does not show the board well enough, or never at an instant at which another camera
            shows it; or the pictures show another board than the given one.
    """
    pycolmap_module()
    sightings = board_sightings(pictures, board)
    sizes = {name: (shots[0].shape[1], shots[0].shape[0]) for name, shots in pictures.items()}
    views = {name: _own_view(name, sightings[name], board, size, lens) for name, size in sizes.items()}
    sensors = _connected_sensors(views)
    poses = _rig_poses(views, sensors, sightings)
    filmed = {
        name: replace(view.filmed, camera=replace(view.filmed.camera, viewmat=torch.from_numpy(sensors[name].copy())))
        for name, view in views.items()
    }
    inliers: Sightings = {name: [s for s in sightings[name] if s.instant in view.poses] for name, view in views.items()}
    for _ in range(2):
        filmed, poses = adjust_board(board, inliers, filmed, poses, lens=lens, rough=True)
        inliers = _without_outliers(inliers, _solved(board, inliers, filmed, poses))
    filmed, poses = adjust_board(board, inliers, filmed, poses, lens=lens)
    return _solved(board, inliers, filmed, poses)


@dataclass(frozen=True)
class _View:
    """A camera by its own sightings: its pose is the identity, and ``poses`` are board to camera by instant."""

    filmed: LensCamera
    poses: Mapping[int, Floats]


def _own_view(
    name: str, own_sightings: Sequence[Sighting], board: Board, size: tuple[int, int], lens: LensModel
) -> _View:
    """Intrinsics from the field of view that fits best, and a pose for each sighting that agrees with them."""
    fullest = sorted(own_sightings, key=lambda sighting: (-len(sighting.corners), sighting.instant))
    chosen = sorted(fullest[: 2 * MAX_SIGHTINGS_ALONE], key=lambda sighting: sighting.instant)
    picks = np.linspace(0, len(chosen) - 1, min(len(chosen), MAX_SIGHTINGS_ALONE)).round().astype(int)
    sample = [chosen[index] for index in picks]
    best: tuple[float, LensCamera] | None = None
    for degrees in FISHEYE_FIELDS_OF_VIEW if lens == "fisheye" else FIELDS_OF_VIEW:
        camera = filmed_camera(guessed_camera(lens, 1, size, degrees), pycolmap_module().Rigid3d())
        poses = _poses(camera, sample, board)
        if len(poses) < max(3, len(sample) // 2):
            continue
        seen = {name: [sighting for sighting in sample if sighting.instant in poses]}
        camera = adjust_board(board, seen, {name: camera}, poses, lens=lens, rough=True)[0][name]
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
    filmed: LensCamera, own_sightings: Sequence[Sighting], board: Board, *, share: float = POSE_PIXELS
) -> dict[int, Floats]:
    """Board-to-camera matrices by instant, of the sightings of which most corners agree."""
    pycolmap = pycolmap_module()
    camera, options = colmap_camera(filmed, 1), pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = max(2.0, share * max(camera.width, camera.height))
    options.ransac.random_seed = 0
    found = {}
    for sighting in own_sightings:
        result = pycolmap.estimate_and_refine_absolute_pose(
            sighting.pixels, board.corners[sighting.corners], camera, options
        )
        if result is not None and result["num_inliers"] >= 0.7 * len(sighting.corners):
            pose = result["cam_from_world"].matrix()
            found[sighting.instant] = rigid(pose[:, :3], pose[:, 3])
    return found


def _misfit(filmed: LensCamera, own_sightings: Sequence[Sighting], board: Board) -> float:
    """Median over the sightings of the median reprojection error, pixels; infinite for one without a pose."""
    poses = _poses(filmed, own_sightings, board)
    errors = [np.inf] * (len(own_sightings) - len(poses))
    for sighting in own_sightings:
        if (pose := poses.get(sighting.instant)) is not None:
            found = filmed.pixels(board.corners[sighting.corners] @ pose[:3, :3].T + pose[:3, 3])
            off = np.linalg.norm(found - sighting.pixels, axis=1)
            errors.append(float(np.median(np.nan_to_num(off, nan=np.inf))))
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


def _without_outliers(sightings: Sightings, found: SolvedCalibration) -> Sightings:
    """Sightings without the corners that are far from where they should be."""
    errors = found.errors()
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
    rough: bool = False,
) -> tuple[dict[str, LensCamera], dict[int, Floats]]:
    """Cameras and board-to-world poses ``[4, 4]`` by instant, adjusted together; the first camera is the world.

    ``rough`` takes a few steps only, with the usual noise and differences of lenses; else these are estimated, too.
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
        rotating=True,
    )
    parameters = solved(bundle, parameters, max_steps=ROUGH_STEPS) if rough else estimated(bundle, parameters)[1]
    parameters = _from_first(parameters)
    matrices = map(rigid, parameters.body_rotations, parameters.body_positions)
    return cameras_in(parameters, cameras, bundle.lens), dict(zip(poses, matrices, strict=True))


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

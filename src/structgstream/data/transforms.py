# SPDX-License-Identifier: Apache-2.0
"""``transforms.json`` of Blender, instant-ngp, nerfstudio and others, as a calibration and as a capture.

Poses are camera to world in OpenGL axes. Intrinsics are at the top or in each frame: ``fl_x``, ``fl_y``, ``cx``,
``cy``, ``w``, ``h``, or angles, as Blender's ``camera_angle_x``; ``k1`` ... ``p2``; ``camera_model``. The top-left
pixel's centre is (0.5, 0.5), as here. ``transforms_test.json`` is held out.

Pictures of one pose are of one camera. If each has a ``time``, the instants are the times; otherwise pictures and
videos are found by the cameras' names, as with other calibrations, so that a file of one instant serves for all. A
broken file, an unknown lens and a camera that moves are a ``CalibrationError``.
"""

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from structgstream.data.calibration import Calibration, PosedCamera, calibration_of, intrinsics
from structgstream.data.images import PICTURE_SUFFIXES, picture_size
from structgstream.data.lenses import Fisheye, Lens, Pinhole, RadialTangential
from structgstream.data.masks import masks_folder
from structgstream.data.posed_capture import of_pictures, open_posed
from structgstream.data.source import FrameSource
from structgstream.data.text_files import (
    NamedFiles,
    Unreadable,
    mapping,
    number,
    path_parts,
    pixels,
    positive,
    read_json,
    readable,
)
from structgstream.data.undistortion import undistort
from structgstream.errors import CalibrationError

WHOLE, TRAIN = "transforms.json", "transforms_train.json"
TEST, VALIDATION = "transforms_test.json", "transforms_val.json"
EXPECTED = "frames with file_path and transform_matrix, and fl_x, cx, cy, w and h or camera_angle_x"
log = logging.getLogger(__name__)

PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE")
OPENCVS = ("OPENCV", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV")
FISHEYES = ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")


@dataclass(frozen=True)
class Shot:
    """A picture of a file of transforms."""

    camera: PosedCamera
    file: Path
    time: float | None  # when it was taken
    held_out: bool
    masked: bool  # whether the file names a mask of it


def find(folder: Path) -> tuple[Path, ...]:
    """The file, or Blender's two."""
    if (folder / WHOLE).is_file():
        return (folder / WHOLE,)
    return tuple(folder / name for name in (TRAIN, TEST) if (folder / TRAIN).is_file() and (folder / name).is_file())


def read(files: tuple[Path, ...]) -> Calibration:
    """A camera for each picture of the files."""
    return _calibration(files[0], read_shots(files))


def _calibration(file: Path, shots: Sequence[Shot]) -> Calibration:
    held_out = [shot.camera.name for shot in shots if shot.held_out]
    return Calibration(file, tuple(shot.camera for shot in shots), held_out=held_out)


def read_shots(files: tuple[Path, ...]) -> list[Shot]:
    """Every picture of the files, in their order."""
    if (files[0].parent / VALIDATION).is_file():
        log.warning("%s: the pictures of %s are left out", files[0].parent, VALIDATION)
    return [shot for file in files for shot in _shots_of(file)]


def _shots_of(file: Path) -> list[Shot]:
    with readable(file, EXPECTED):
        content = mapping(read_json(file))
        frames = [{**content, **mapping(frame)} for frame in content["frames"]]
        entries = [(str(frame["file_path"]), frame) for frame in frames]
    pictures = NamedFiles(file.parent, PICTURE_SUFFIXES)
    shots: list[Shot] = []

    def camera(name: str, frame: dict[str, Any]) -> PosedCamera:
        picture = pictures.find(name) or file.parent.joinpath(*path_parts(name))
        time = None if frame.get("time") is None else number(frame["time"])
        posed = _camera(name, frame, picture, file)
        shots.append(Shot(posed, picture, time, file.name == TEST, frame.get("mask_path") is not None))
        return posed

    calibration_of(entries, camera, file=file, expected=EXPECTED)
    return shots


def stated_fps(file: Path) -> float | None:
    """The frames a second that a file states, or None."""
    with readable(file, "fps as a number of frames a second"):
        content = mapping(read_json(file))
        return None if content.get("fps") is None else positive(content, "fps")


def _camera(name: str, frame: dict[str, Any], picture: Path, where: Path) -> PosedCamera:
    if frame.get("w") is not None and frame.get("h") is not None:
        width, height = pixels((frame["w"], frame["h"]))
    elif picture.is_file():
        width, height = picture_size(picture)
    else:
        raise KeyError("w and h")
    fx, fy = _focal(frame, "x", width), _focal(frame, "y", height)
    if fx is None and fy is None:
        raise KeyError("fl_x or camera_angle_x")
    stated = {key: frame[key] for key in ("cx", "cy") if frame.get(key) is not None}
    cx, cy = stated.get("cx", width / 2), stated.get("cy", height / 2)
    K = intrinsics(fy if fx is None else fx, fx if fy is None else fy, cx, cy)  # square pixels if one is stated
    pose = np.array(frame["transform_matrix"], dtype=np.float64)
    pose = np.vstack([pose, [0, 0, 0, 1]]) if pose.shape == (3, 4) else pose.reshape(4, 4)
    viewmat = np.linalg.inv(pose @ np.diag([1.0, -1.0, -1.0, 1.0])).astype(np.float64)
    inside = picture.relative_to(where.parent).as_posix()
    return PosedCamera(inside, viewmat, K, (width, height), _lens(name, frame, where))


def _focal(frame: dict[str, Any], axis: str, side: int) -> float | None:
    """The focal length along an axis in pixels, which may be stated as the angle that the picture's side spans."""
    if frame.get(f"fl_{axis}") is not None:
        return number(frame[f"fl_{axis}"])
    if frame.get(f"camera_angle_{axis}") is None:
        return None
    angle = number(frame[f"camera_angle_{axis}"])
    if not 0 < angle < math.pi:
        raise Unreadable(f"camera_angle_{axis} of {angle:g} radians")
    return side / 2 / math.tan(angle / 2)


def _lens(name: str, frame: dict[str, Any], where: Path) -> Lens:
    """The lens of a picture, whose model may be one of COLMAP's names."""
    model = "OPENCV_FISHEYE" if frame.get("is_fisheye") else str(frame.get("camera_model") or "OPENCV").upper()
    k1, k2, k3, k4, p1, p2 = (number(frame.get(key) or 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    if model in FISHEYES:
        return Fisheye(k1, k2, k3, k4)
    # As nerfstudio and instant-ngp do: coefficients count whatever the name of the model.
    if model in (*PINHOLES, *OPENCVS) and not any((k1, k2, k3, k4, p1, p2)):
        return Pinhole()
    if model not in (*PINHOLES, *OPENCVS) or (k4 and model != "FULL_OPENCV"):
        raise CalibrationError(
            f"The camera of {name!r} of {where} is of the model {model}{' with k4' if k4 else ''}, which is not known "
            f"here; expected {', '.join((*PINHOLES, *OPENCVS, *FISHEYES))} (k1, k2, k3, p1, p2)."
        )
    k5, k6 = (number(frame.get(key) or 0.0) for key in ("k5", "k6"))
    return RadialTangential(k1, k2, p1, p2, k3, k4, k5, k6)


SAME = 6  # digits in which poses of one camera agree


def open_transforms(path: Path) -> FrameSource:
    """The capture at ``path``; what ``transforms_test.json`` lists is held out."""
    files = find(path)
    shots = read_shots(files)
    if any(shot.masked for shot in shots) and not masks_folder(path).is_dir():
        log.warning("%s names masks (mask_path), which are not read; copy them to masks/CAMERA/FRAME.png", files[0])
    if files[0].name == WHOLE and any(shot.time is None for shot in shots):
        return open_posed(path, _calibration(files[0], shots), fps=stated_fps(files[0]))
    cameras = _by_pose(shots, files[0])
    zero = min([0.0, *(shot.time for shot in shots if shot.time is not None)])
    pictures = {name: _instants(own, zero) for name, own in cameras.items()}
    poses = {name: own[0].camera for name, own in cameras.items()}
    held_out = [name for name, own in cameras.items() if own[0].held_out]
    found = Calibration(files[0], tuple(poses.values()), held_out=held_out)
    return undistort(*of_pictures(path, pictures, poses, root=path, calibration=found, fps=stated_fps(files[0])))


def _by_pose(shots: Sequence[Shot], where: Path) -> Mapping[str, Sequence[Shot]]:
    """The pictures of each camera, by a name that its files share."""
    groups: dict[tuple[float, ...], list[Shot]] = {}
    for shot in shots:
        camera = shot.camera
        key = (*camera.viewmat.round(SAME).ravel().tolist(), *camera.K.round(3).ravel().tolist(), shot.held_out)
        groups.setdefault(key, []).append(shot)
    if len({shot.time for shot in shots}) > 1 and all(len(own) == 1 for own in groups.values()):
        raise CalibrationError(
            f"Every picture of {where} has a pose and a time of its own: one camera that moves; expected several that "
            "stand still."
        )
    listed = list(groups.values())
    for part in ("parent", "stem"):
        names = [{_part(shot.file, part) for shot in own} for own in listed]
        if all(len(name) == 1 for name in names) and len(set.union(*names)) == len(listed):
            return dict(sorted((_part(own[0].file, part), own) for own in listed))
    return {f"cam{number:02d}": own for number, own in enumerate(listed)}


def _part(file: Path, part: str) -> str:
    return file.parent.name if part == "parent" else file.stem


def _instants(shots: Sequence[Shot], zero: float) -> dict[str, Path]:
    """The pictures of a camera by time from ``zero`` on, since names have no sign, or by the part of their names that
    differs."""
    times = [shot.time for shot in shots if shot.time is not None]
    if len(times) == len(shots):
        return {f"{time - zero:.6f}": shot.file for time, shot in zip(times, shots, strict=True)}
    if len(shots) == 1:
        return {"0": shots[0].file}
    part = "stem" if len({shot.file.stem for shot in shots}) == len(shots) else "parent"
    return {_part(shot.file, part): shot.file for shot in shots}

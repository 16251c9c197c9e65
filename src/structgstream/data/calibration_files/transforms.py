# SPDX-License-Identifier: Apache-2.0
"""``transforms.json`` of Blender, instant-ngp, nerfstudio and others: camera to world in OpenGL axes.

Intrinsics stand at the top or with a frame: ``fl_x``, ``fl_y``, ``cx``, ``cy``, ``w``, ``h``, or Blender's
``camera_angle_x``; ``k1`` ... ``p2``; ``camera_model``. The top-left pixel's centre is (0.5, 0.5), as here.
``transforms_test.json`` is held out.
"""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from structgstream.data.calibration_files.reading import each_camera, readable
from structgstream.data.images import PICTURE_SUFFIXES
from structgstream.data.lenses import Fisheye, Lens, Pinhole, RadialTangential, finite
from structgstream.data.picture_size import picture_size
from structgstream.data.posed import Calibration, PosedCamera, intrinsics
from structgstream.errors import CalibrationError

WHOLE, TRAIN, TEST = "transforms.json", "transforms_train.json", "transforms_test.json"
EXPECTED = "frames with file_path and transform_matrix, and fl_x, cx, cy, w and h or camera_angle_x"
PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE")


@dataclass(frozen=True)
class Shot:
    """A picture of a file of transforms: its camera, where it lies, when it was taken and whether it is held out."""

    camera: PosedCamera
    file: Path
    time: float | None
    held_out: bool


def find(folder: Path) -> tuple[Path, ...]:
    """The file, or Blender's two."""
    if (folder / WHOLE).is_file():
        return (folder / WHOLE,)
    return tuple(folder / name for name in (TRAIN, TEST) if (folder / TRAIN).is_file() and (folder / name).is_file())


def read(files: tuple[Path, ...]) -> Calibration:
    """A camera for each picture of the files.

    Raises:
        CalibrationError: they are broken.
    """
    shots = read_shots(files)
    held_out = [shot.camera.name for shot in shots if shot.held_out]
    return Calibration(files[0], tuple(shot.camera for shot in shots), held_out=held_out)


def read_shots(files: tuple[Path, ...]) -> list[Shot]:
    """Every picture of the files, in their order.

    Raises:
        CalibrationError: they are broken, or a lens is not known here.
    """
    shots = []
    for file in files:
        with readable(file, EXPECTED):
            content = json.loads(file.read_text())
            frames = [{**content, **frame} for frame in content["frames"]]
            entries = [(str(frame["file_path"]), frame) for frame in frames]
        paths = {name: _picture(file.parent, name) for name, _ in entries}

        def camera(name: str, frame: dict[str, Any], paths: dict[str, Path] = paths, file: Path = file) -> PosedCamera:
            return _camera(name, frame, paths[name], file)

        cameras = each_camera(entries, camera, file=file, expected=EXPECTED)
        for posed, (name, frame) in zip(cameras, entries, strict=True):
            time = float(frame["time"]) if "time" in frame else None
            shots.append(Shot(posed, paths[name], time, file.name == TEST))
    return shots


def _picture(folder: Path, name: str) -> Path:
    """The file of a ``file_path``, which Blender's leave without a suffix."""
    path = folder / name
    return path if path.suffix.lower() in PICTURE_SUFFIXES or path.is_file() else path.with_name(f"{path.name}.png")


def _camera(name: str, frame: dict[str, Any], picture: Path, where: Path) -> PosedCamera:
    if "w" in frame and "h" in frame:
        width, height = round(frame["w"]), round(frame["h"])
    elif picture.is_file():
        width, height = picture_size(picture)
    else:
        raise KeyError("w and h")
    fx = float(frame["fl_x"]) if "fl_x" in frame else width / 2 / math.tan(float(frame["camera_angle_x"]) / 2)
    fy = float(frame.get("fl_y", fx))
    K = intrinsics(fx, fy, float(frame.get("cx", width / 2)), float(frame.get("cy", height / 2)))
    pose = np.array(frame["transform_matrix"], dtype=np.float64)
    pose = np.vstack([pose, [0, 0, 0, 1]]) if pose.shape == (3, 4) else pose.reshape(4, 4)
    viewmat = np.linalg.inv(pose @ np.diag([1.0, -1.0, -1.0, 1.0])).astype(np.float64)
    return PosedCamera(
        picture.relative_to(where.parent).as_posix(), viewmat, K, (width, height), _lens(name, frame, where)
    )


def _lens(name: str, frame: dict[str, Any], where: Path) -> Lens:
    model = "OPENCV_FISHEYE" if frame.get("is_fisheye") else str(frame.get("camera_model", "OPENCV"))
    k1, k2, k3, k4, p1, p2 = (finite(frame.get(key) or 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    if model == "OPENCV_FISHEYE":
        return Fisheye(k1, k2, k3, k4)
    if model in PINHOLES or (model == "OPENCV" and not any((k1, k2, k3, k4, p1, p2))):
        return Pinhole()
    if model != "OPENCV" or k4:
        raise CalibrationError(
            f"The camera of {name!r} of {where} is of the model {model}{' with k4' if k4 else ''}, which is not known "
            "here; expected PINHOLE, OPENCV (k1, k2, k3, p1, p2) or OPENCV_FISHEYE."
        )
    return RadialTangential(k1, k2, p1, p2, k3)

# SPDX-License-Identifier: Apache-2.0
"""Reads a COLMAP model, text or binary: ``cameras``, ``images`` and ``points3D``.

The format is that of COLMAP's documentation, "Output Format". Poses are world to camera with OpenCV axes,
and the top-left pixel's centre is (0.5, 0.5): both as in this package.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from structgstream.errors import CalibrationError

PINHOLES = {"SIMPLE_PINHOLE": 3, "PINHOLE": 4}  # number of parameters
MODEL_NAMES = (
    "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV",
    "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE",
)  # fmt: skip


@dataclass(frozen=True)
class ColmapCamera:
    """Intrinsics shared by images: ``K [3, 3]`` in pixels and the size they are for."""

    K: NDArray[np.float64]
    width: int
    height: int


@dataclass(frozen=True)
class ColmapImage:
    """A registered picture: its name in the model, ``viewmat [4, 4]`` world to camera, and its intrinsics."""

    name: str
    viewmat: NDArray[np.float64]
    camera: ColmapCamera


@dataclass(frozen=True)
class ColmapModel:
    """A model: its pictures by name, and its points ``[P, 3]``."""

    folder: Path
    images: tuple[ColmapImage, ...]
    points: NDArray[np.float64]


def find_model(path: Path) -> Path | None:
    """The folder of the model that belongs to a capture, or None."""
    for folder in (path / "sparse" / "0", path / "sparse", path):
        if any(
            (folder / f"cameras{end}").is_file() and (folder / f"images{end}").is_file() for end in (".bin", ".txt")
        ):
            return folder
    return None


def read_model(folder: Path) -> ColmapModel:
    """The model in ``folder``; binary files are preferred.

    Raises:
        CalibrationError: the files are cut or not a model, or a camera has lens distortion.
    """
    binary = (folder / "cameras.bin").is_file() and (folder / "images.bin").is_file()
    try:
        if binary:
            cameras = _binary_cameras(folder / "cameras.bin")
            images = _binary_images(folder / "images.bin", cameras)
        else:
            cameras = _text_cameras(folder / "cameras.txt")
            images = _text_images(folder / "images.txt", cameras)
        points = _points(folder)
    except CalibrationError:
        raise
    except (OSError, ValueError, KeyError, IndexError, struct.error) as error:
        raise CalibrationError(
            f"The COLMAP model in {folder} cannot be read ({type(error).__name__}: {error}); export it again."
        ) from None
    return ColmapModel(folder, tuple(sorted(images, key=lambda image: image.name)), points)


def _camera(model: str, width: int, height: int, params: tuple[float, ...], where: Path) -> ColmapCamera:
    if model not in PINHOLES:
        raise CalibrationError(
            f"{where} has a camera of model {model}, which has lens distortion; undistort the pictures and "
            "the model (colmap image_undistorter) so that every camera is PINHOLE or SIMPLE_PINHOLE."
        )
    fx, fy, cx, cy = params if model == "PINHOLE" else (params[0], *params)
    return ColmapCamera(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), width, height)


def _image(name: str, pose: tuple[float, ...], camera: ColmapCamera) -> ColmapImage:
    """From a quaternion (w, x, y, z) and a translation."""
    w, x, y, z = np.array(pose[:4]) / np.linalg.norm(pose[:4])
    viewmat = np.eye(4)
    viewmat[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    viewmat[:3, 3] = pose[4:]
    return ColmapImage(name, viewmat, camera)


def _lines(file: Path) -> Iterator[str]:
    return (line for line in file.read_text().splitlines() if not line.startswith("#"))


def _text_cameras(file: Path) -> dict[int, ColmapCamera]:
    cameras = {}
    for line in _lines(file):
        if words := line.split():
            params = tuple(float(word) for word in words[4:])
            cameras[int(words[0])] = _camera(words[1], int(words[2]), int(words[3]), params, file)
    return cameras


def _text_images(file: Path, cameras: dict[int, ColmapCamera]) -> list[ColmapImage]:
    images = []
    lines = _lines(file)
    for line in lines:
        words = line.split(maxsplit=9)
        if not words:
            continue
        next(lines, None)  # the picture's 2D points; the line may be empty
        pose = tuple(float(word) for word in words[1:8])
        images.append(_image(words[9].strip(), pose, cameras[int(words[8])]))
    return images


def _binary_cameras(file: Path) -> dict[int, ColmapCamera]:
    data = file.read_bytes()
    (count,) = struct.unpack_from("<Q", data)
    offset, cameras = 8, {}
    for _ in range(count):
        number, model, width, height = struct.unpack_from("<iiQQ", data, offset)
        name = MODEL_NAMES[model] if 0 <= model < len(MODEL_NAMES) else f"number {model}"
        params = struct.unpack_from(f"<{PINHOLES.get(name, 0)}d", data, offset + 24)
        cameras[number] = _camera(name, width, height, params, file)
        offset += 24 + 8 * len(params)
    return cameras


def _binary_images(file: Path, cameras: dict[int, ColmapCamera]) -> list[ColmapImage]:
    data = file.read_bytes()
    (count,) = struct.unpack_from("<Q", data)
    offset, images = 8, []
    for _ in range(count):
        _, *pose, camera = struct.unpack_from("<i7di", data, offset)
        end = data.index(b"\0", offset + 64)
        images.append(_image(data[offset + 64 : end].decode(), tuple(pose), cameras[camera]))
        (observations,) = struct.unpack_from("<Q", data, end + 1)
        offset = end + 9 + 24 * observations
    _check_end(data, offset)
    return images


def _check_end(data: bytes, offset: int) -> None:
    if offset > len(data):
        raise ValueError(f"a file ends {offset - len(data)} bytes early")


def _points(folder: Path) -> NDArray[np.float64]:
    """Positions ``[P, 3]``, empty when the model has no points file."""
    positions: list[tuple[float, ...]] = []
    if (folder / "points3D.bin").is_file():
        data = (folder / "points3D.bin").read_bytes()
        (count,) = struct.unpack_from("<Q", data)
        offset = 8
        for _ in range(count):
            positions.append(struct.unpack_from("<3d", data, offset + 8))
            (observations,) = struct.unpack_from("<Q", data, offset + 43)
            offset += 51 + 8 * observations
        _check_end(data, offset)
    elif (folder / "points3D.txt").is_file():
        rows = (line.split(maxsplit=4) for line in _lines(folder / "points3D.txt"))
        positions = [tuple(float(word) for word in row[1:4]) for row in rows if row]
    return np.array(positions, dtype=np.float64).reshape(-1, 3)

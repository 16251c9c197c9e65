# SPDX-License-Identifier: Apache-2.0
"""Reads a COLMAP model, text or binary: ``cameras``, ``images`` and ``points3D``.

The format is that of COLMAP's documentation, "Output Format". Poses are world to camera with OpenCV axes,
and the top-left pixel's centre is (0.5, 0.5): both as in this package. Files that are cut or no model, and lens models
that are not known here, are a ``CalibrationError``.
"""

import logging
import re
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from structgstream.data.calibration import Calibration, PosedCamera, intrinsics, rigid
from structgstream.data.lenses import Fisheye, Lens, Pinhole, RadialTangential
from structgstream.data.text_files import Unreadable, number, pixels, read_text, readable, whole
from structgstream.data.timeline import natural
from structgstream.errors import CalibrationError
from structgstream.geometry import quaternion_matrices

log = logging.getLogger(__name__)

MODELS = {
    "SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8, "OPENCV_FISHEYE": 8,
    "FULL_OPENCV": 12, "FOV": 0, "SIMPLE_RADIAL_FISHEYE": 4, "RADIAL_FISHEYE": 5, "THIN_PRISM_FISHEYE": 0,
}  # fmt: skip
"""COLMAP's camera models in the order of their numbers, and how many parameters each has: 0 where lenses.py has no such
lens."""


def find_model(path: Path) -> Path | None:
    """The folder of the model that belongs to a capture, or None; of several in ``sparse`` the one of most pictures.

    4DGaussians' loaders of many videos have theirs in ``sparse_``.
    """
    sparse = path / "sparse"
    numbered = [entry for entry in sparse.iterdir() if entry.is_dir()] if sparse.is_dir() else []
    models = [folder for folder in sorted(numbered, key=lambda folder: natural(folder.name)) if is_model(folder)]
    if models:
        return max(models, key=_registered) if len(models) > 1 else models[0]
    return next((folder for folder in (sparse, path, path / "sparse_") if is_model(folder)), None)


def is_model(folder: Path) -> bool:
    """Whether a folder holds the files of a model."""
    return any((folder / f"cameras{end}").is_file() and (folder / f"images{end}").is_file() for end in (".bin", ".txt"))


def _registered(folder: Path) -> int:
    """How many pictures a model has."""
    try:
        if (folder / "images.bin").is_file():
            with (folder / "images.bin").open("rb") as stream:
                return struct.unpack("<Q", stream.read(8))[0]
        return sum(1 for _ in _image_rows(folder / "images.txt"))
    except (OSError, ValueError, struct.error):
        return 0


def warn_of_other_models(folder: Path) -> None:
    """Warns of models other than the one in ``folder``, which are left out."""
    others = [other for other in folder.parent.iterdir() if other != folder and is_model(other)]
    if folder.parent.name == "sparse" and others:
        rest = ", ".join(f"{other.name} of {_registered(other)}" for other in sorted(others))
        log.warning(
            "%s holds several models: number %s of %d pictures is taken, number %s left out; merge them (colmap "
            "model_merger) if cameras lack",
            folder.parent, folder.name, _registered(folder), rest,
        )  # fmt: skip


def read_model(folder: Path) -> Calibration:
    """The model in ``folder``; binary files are preferred. Its cameras have the names of its pictures."""
    warn_of_other_models(folder)
    binary = (folder / "cameras.bin").is_file() and (folder / "images.bin").is_file()
    with readable(f"The COLMAP model in {folder}", "cameras, images and points3D as COLMAP writes them"):
        if binary:
            cameras = _binary_cameras(folder / "cameras.bin")
            images = _binary_images(folder / "images.bin", cameras)
        else:
            cameras = _text_cameras(folder / "cameras.txt")
            images = _text_images(folder / "images.txt", cameras)
        points = _points(folder)
    ordered = tuple(sorted(images, key=lambda image: image.name))
    return Calibration(folder, ordered, points if len(points) else None, turned_by_exif=False)


ColmapCamera = tuple[NDArray[np.float64], tuple[int, int], Lens]
"""``K`` ``[3, 3]`` in pixels, the size it is for, the lens."""


def _camera(model: str, width: int, height: int, params: Sequence[Any], where: Path) -> ColmapCamera:
    values = tuple(map(number, params))
    if len(values) != _parameters(model, where):
        raise Unreadable(f"{len(values)} parameters of a {model}")
    one_focal_length = "SIMPLE" in model or "RADIAL" in model
    fx, fy, cx, cy, *coefficients = (values[0], *values) if one_focal_length else values
    lens: Lens = Pinhole()
    if model.endswith("FISHEYE"):
        lens = Fisheye(*coefficients)
    elif "PINHOLE" not in model:
        lens = RadialTangential(*coefficients)
    return intrinsics(fx, fy, cx, cy), pixels((width, height)), lens


def _parameters(model: str, where: Path) -> int:
    """How many parameters a model has."""
    if not (count := MODELS.get(model)):
        raise CalibrationError(
            f"{where} has a camera of model {model}, whose lens is not known here; calibrate again with one of "
            f"{', '.join(filter(MODELS.get, MODELS))}, or undistort pictures and model (colmap image_undistorter)."
        )
    return count


def _image(name: str, pose: tuple[float, ...], cameras: dict[int, ColmapCamera], own: int) -> PosedCamera:
    """A picture of camera ``own``, from a quaternion (w, x, y, z) and a translation."""
    if own not in cameras:
        raise Unreadable(f"no camera {own} for a picture")
    if not 0 < float(np.linalg.norm(pose[:4])) < np.inf:
        raise Unreadable("a rotation that is no quaternion")
    rotation = quaternion_matrices(torch.tensor(pose[:4], dtype=torch.float64)).numpy()
    return PosedCamera(name, rigid(rotation, pose[4:]), *cameras[own])


def _lines(file: Path) -> Iterator[str]:
    return (line for line in read_text(file).split("\n") if not line.startswith("#"))


def _text_cameras(file: Path) -> dict[int, ColmapCamera]:
    cameras = {}
    for words in filter(None, map(str.split, _lines(file))):
        cameras[whole(words[0])] = _camera(words[1], whole(words[2]), whole(words[3]), words[4:], file)
    return cameras


def _image_rows(file: Path) -> Iterator[str]:
    """The lines of pictures: of each the first line of two, or every line of a list without 2D points."""
    points_follow = False
    for line in _lines(file):
        if points_follow and _is_points(line):
            points_follow = False
        elif line.strip():
            points_follow = True
            yield line


def _is_points(line: str) -> bool:
    """Whether a line is empty or holds triples whose third is the number of a point, which no rotation or name is."""
    words = line.split()
    return not words or (len(words) % 3 == 0 and all(re.fullmatch(r"-?\d+", words[place]) for place in (2, -1)))


def _text_images(file: Path, cameras: dict[int, ColmapCamera]) -> list[PosedCamera]:
    images = []
    for line in _image_rows(file):
        words = line.split(maxsplit=9)
        if len(words) < 10:
            raise Unreadable(f"a picture's line of {file.name} has {len(words)} words; expected 10")
        name = words[9].strip()
        try:
            pose = tuple(number(word) for word in words[1:8])
            images.append(_image(name, pose, cameras, whole(words[8])))
        except Unreadable as error:
            raise Unreadable(f"picture {name!r}: {error}") from None
    return images


def _binary_cameras(file: Path) -> dict[int, ColmapCamera]:
    data = file.read_bytes()
    (count,) = struct.unpack_from("<Q", data)
    offset, cameras = 8, {}
    for _ in range(count):
        own, model, width, height = struct.unpack_from("<iiQQ", data, offset)
        name = dict(enumerate(MODELS)).get(model, f"number {model}")
        params = struct.unpack_from(f"<{_parameters(name, file)}d", data, offset + 24)
        cameras[own] = _camera(name, width, height, params, file)
        offset += 24 + 8 * len(params)
    return cameras


def _binary_images(file: Path, cameras: dict[int, ColmapCamera]) -> list[PosedCamera]:
    data = file.read_bytes()
    (count,) = struct.unpack_from("<Q", data)
    offset, images = 8, []
    for _ in range(count):
        _, *pose, camera = struct.unpack_from("<i7di", data, offset)
        end = data.index(b"\0", offset + 64)
        images.append(_image(data[offset + 64 : end].decode(), tuple(pose), cameras, camera))
        (observations,) = struct.unpack_from("<Q", data, end + 1)
        offset = end + 9 + 24 * observations
    _check_end(data, offset)
    return images


def _check_end(data: bytes, offset: int) -> None:
    if offset > len(data):
        raise Unreadable(f"a file ends {offset - len(data)} bytes early")


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
        positions = [
            tuple(number(word) for word in line.split(maxsplit=4)[1:4])
            for line in _lines(folder / "points3D.txt")
            if line.strip()
        ]
    points = np.array(positions, dtype=np.float64).reshape(-1, 3)
    return points[np.isfinite(points).all(1)]

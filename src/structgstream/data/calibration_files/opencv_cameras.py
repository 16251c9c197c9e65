# SPDX-License-Identifier: Apache-2.0
"""OpenCV's ``FileStorage``, XML or YAML: a file a camera, named after it or in its folder, or one file of all.

OpenPose: ``CameraMatrix`` (3x4, world to camera), ``Intrinsics``, ``Distortion``. MC-Calib: ``camera_0`` and so on with
``camera_matrix`` and ``camera_pose_matrix`` (camera to world). Others spell what they hold as :data:`SPELLINGS` has it.
"""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from structgstream.data.calibration import CalibrationFormat, NoPose, PosedCamera, common_folder, rigid
from structgstream.data.calibration_files.reading import LARGEST_BYTES, may_be_storage, read_storage
from structgstream.data.calibration_files.tools import EXTRINSICS, INTRINSICS, decompose_projection, opencv_camera
from structgstream.data.text_files import Unreadable, number, read_text, reason
from structgstream.errors import CalibrationError

EXPECTED = (
    "camera_matrix, distortion_coefficients, image_width, image_height and the camera's pose, R and T, or "
    "Intrinsics, Distortion and CameraMatrix (3x4)"
)
SPELLINGS: Mapping[str, tuple[str, ...]] = {
    "K": ("intrinsic", "k", "m", ""),
    "distortion": ("distortion", "dist", "d"),
    "rotation": ("rotation", "rot", "r"),
    "translation": ("translation", "trans", "t"),
    "pose": ("extrinsic", "view", "rt", ""),
    "inverse pose": ("camerapose", "c2w", "2world", "toworld"),
    "projection": ("projection", "proj", "p"),
    "width": ("imagewidth", "imgwidth", "framewidth", "width", "w"),
    "height": ("imageheight", "imgheight", "frameheight", "height", "h"),
    "size": ("imagesize", "imgsize", "size", "resolution"),
    "name": ("name", "id", "serial"),
    "fisheye": ("fisheyemodel", "fisheye", "isfisheye", "distortiontype"),
    "lens": ("distortiontype", "distortionmodel", "lensmodel", "lenstype", "len", "projectiontype", "model", "type"),
}  # fmt: skip
"""Keys without marks between words, without :data:`FILLING` and in lower case; of several the first counts."""
FILLING = re.compile(
    r"world2cam(era)?|worldtocam(era)?|w2c|camera(?!pose)|cam(?!erapose)|matrix|mat|mtx|vector|vec|coefficients?|coeffs?|coefs?|"
    r"param(eter)?s?|s$"
)
FISHEYES = re.compile(r"fish|equidist|\bequi\b|kannala")
OTHER_LENSES = re.compile(r"omni(?!vision)|unified|ucm|double.?sphere|division|equirect")
"""Words in the names of lens models: of OpenCV's fisheye, and of those that are not known here. Others are OpenCV's or
names of products."""
POSE_SHAPES = {(3, 4): (3, 4), (12,): (3, 4), (4, 4): (4, 4), (16,): (4, 4)}
SHAPES = {
    "K": {(3, 3): (3, 3), (9,): (3, 3)}, "pose": POSE_SHAPES, "inverse pose": POSE_SHAPES, "projection": POSE_SHAPES,
}  # fmt: skip
"""What a matrix may look like, as a list or as rows, and what it is then."""
SUFFIXES = (".xml", ".yml", ".yaml", ".json")


def _find(folder: Path) -> Iterator[tuple[Path, ...]]:
    """The files of a folder that hold cameras, together; else those of its folders, one in each."""
    if found := _files(folder):
        yield found
        return
    folders = sorted(entry for entry in folder.iterdir() if entry.is_dir() and not entry.name.startswith("."))
    inside = [files[0] for files in map(_files, folders) if len(files) == 1]
    if len(inside) > 1:
        yield tuple(inside)


def _files(folder: Path) -> tuple[Path, ...]:
    """The files with cameras, then those of OpenCV that cannot be parsed, which reading refuses."""
    try:
        files = [file for file in sorted(folder.iterdir()) if file.suffix.lower() in SUFFIXES and file.is_file()]
    except OSError:
        return ()
    holding, broken = [], []
    for file in files:
        if file.name in (INTRINSICS, EXTRINSICS) or file.stat().st_size > LARGEST_BYTES or not may_be_storage(file):
            continue
        try:
            if (tables := _tables(file)) and (file.suffix.lower() != ".json" or any(map(_own_pose, tables.values()))):
                holding.append(file)
        except OSError:
            continue
        except Unreadable:  # YAML of others is no camera's
            if re.search("opencv[-_](matrix|storage)", read_text(file)):
                broken.append(file)
    return tuple(holding + broken if holding else broken)


def _entries(files: tuple[Path, ...]) -> Iterator[tuple[str, dict[str, Any]]]:
    """A camera for each file, or for each map of the one file."""
    shared = len({file.parent for file in files}) == 1
    where = files[0].parent if shared else files[0].parent.parent
    for file in files:
        name = file.stem if shared else file.parent.name
        try:
            tables = _tables(file)
        except (OSError, Unreadable) as error:
            raise CalibrationError(
                f"Camera {name!r} of {where} cannot be read ({reason(error)}); expected {EXPECTED}."
            ) from None
        if len(groups := {str(content.get("camera_group", 0)) for content in tables.values()}) > 1:
            raise CalibrationError(
                f"{file} has {len(groups)} groups of cameras that saw no board in common, each with a world of its "
                "own; film the board so that every camera shares it with another, and calibrate again."
            )
        yield from ((own or name, content) for own, content in tables.items() or {name: {}}.items())


def _tables(file: Path) -> dict[str, dict[str, Any]]:
    """What a file holds of each camera by its name, which is empty for the one of the whole file."""
    content = _with_intrinsics(read_storage(file))
    if _value(content, "K") is not None:
        return {"": content}
    named: list[tuple[Any, Any]] = list(content.items())
    for group in content.values():  # such as ``cameras``
        if isinstance(group, dict):
            named += group.items()
        elif isinstance(group, list):
            listed = enumerate(one for one in group if isinstance(one, dict))
            named += ((index if (name := _value(one, "name")) is None else name, one) for index, one in listed)
    split = ((str(key), _with_intrinsics(one)) for key, one in named if isinstance(one, dict))
    return {key: one for key, one in split if _value(one, "K") is not None}


def _with_intrinsics(content: dict[str, Any]) -> dict[str, Any]:
    """The same with what a projection matrix holds, where it is all there is."""
    projection = _value(content, "projection")
    if projection is None or _value(content, "K") is not None:
        return content
    K, viewmat = decompose_projection(projection)
    return {**content, "K": K, "R": viewmat[:3, :3], "T": viewmat[:3, 3]}


def _camera(name: str, content: dict[str, Any]) -> PosedCamera:
    K = _value(content, "K")
    if K is None:
        raise KeyError("camera_matrix or intrinsics or K")
    size = _value(content, "size")
    width, height = (_value(size if isinstance(size, dict) else content, key) for key in ("width", "height"))
    size = None if size is None or isinstance(size, dict) else np.ravel(size).tolist()
    if size is None and width is not None and height is not None and number(width) > 0 and number(height) > 0:
        size = (width, height)
    dist = _value(content, "distortion")
    return opencv_camera(name, _pose(content), K=K, dist=dist, size=size, fisheye=_is_fisheye(content))


def _is_fisheye(content: dict[str, Any]) -> bool:
    """Whether a camera is of OpenCV's fisheye model, by a flag or by the name of its model."""
    names = " ".join(str(value).lower() for value in _values(content, "lens"))
    if OTHER_LENSES.search(names):
        raise Unreadable(f"the lens model {names}, which is not known here")
    flags = [str(value).lower() for value in _values(content, "fisheye")]
    return not {"1", "true", "yes"}.isdisjoint(flags) or FISHEYES.search(f"{names} {' '.join(flags)}") is not None


def _own_pose(content: dict[str, Any]) -> bool:
    """Whether a camera's entry has its pose; JSON of other tools has poses elsewhere, or in other units."""
    return "distCoef" not in content and (
        any(_value(content, key) is not None for key in ("pose", "inverse pose"))
        or all(_value(content, key) is not None for key in ("rotation", "translation"))
    )


def _pose(content: dict[str, Any]) -> np.ndarray:
    """World to camera, ``[4, 4]``."""
    for key in ("pose", "inverse pose"):
        if (matrix := _value(content, key)) is not None:
            viewmat = np.vstack([matrix, np.eye(4)[len(matrix) :]])
            return np.linalg.inv(viewmat) if key == "inverse pose" else viewmat
    rotation, translation = _value(content, "rotation"), _value(content, "translation")
    if rotation is None or translation is None:
        raise NoPose
    return rigid(rotation, translation)


def _value(content: dict[str, Any], key: str) -> Any:
    """The first value that is spelled as ``key`` and has its shape; None where there is none."""
    values = _values(content, key)
    if key in SHAPES:
        values = [matrix for value in values if (matrix := _shaped(value, SHAPES[key])) is not None]
    return next(iter(values), None)


def _values(content: dict[str, Any], key: str) -> list[Any]:
    """What is spelled as ``key``, in the order of :data:`SPELLINGS`."""
    plain = [(FILLING.sub("", re.sub(r"[^a-z0-9]", "", name.lower())), value) for name, value in content.items()]
    return [value for spelling in SPELLINGS[key] for name, value in plain if name == spelling and value is not None]


def _shaped(value: Any, shapes: Mapping[tuple[int, ...], tuple[int, ...]]) -> np.ndarray | None:
    """A matrix of one of these shapes; None for anything else, as a list of as many words."""
    try:
        matrix = np.array(value, np.float64)
    except (TypeError, ValueError):
        return None
    return None if (shape := shapes.get(matrix.shape)) is None else matrix.reshape(shape)


OPENCV_CAMERAS = CalibrationFormat(_find, _entries, _camera, EXPECTED, turned_by_exif=True, where=common_folder)

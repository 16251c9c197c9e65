# SPDX-License-Identifier: Apache-2.0
"""The calibration of a project folder, as COLMAP, transforms.json or a file of another tool, in it or one folder below.

Tools separate calibration and videos: Pose2Sim has ``calibration/Calib.toml`` next to ``videos/``, caliscope
``camera_array.toml`` above ``recordings/TAKE/``, 3DGStream the model of COLMAP in the folder of the first frame. One
that is broken or refused, or several that differ, are a ``CalibrationError``.
"""

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from structgstream.data import transforms
from structgstream.data.calibration import Calibration, PosedCamera
from structgstream.data.calibration_files import tools
from structgstream.data.calibration_files.opencv_cameras import OPENCV_CAMERAS
from structgstream.data.camera_files import (
    NO_CAMERAS,
    files_of,
    folders_of,
    has_files,
    has_frames,
    pictures_in,
    roots_of,
    videos_in,
)
from structgstream.data.colmap import find_model, read_model
from structgstream.data.images import PICTURE_SUFFIXES
from structgstream.errors import CalibrationError

log = logging.getLogger(__name__)

PICKLES = (".pickle", ".pkl")
SAME_ROTATION, SAME_SHARE, SAME_PIXELS = 1e-3, 0.01, 1.0
"""How far two files of one calibration differ: entries of rotations, shares of the rig's extent, pixels of K."""


CALIBRATION_FORMATS = (
    tools.ANIPOSE,
    tools.EASYMOCAP,
    tools.MULTICAL,
    tools.KALIBR,
    tools.CMU_PANOPTIC,
    tools.QUALISYS,
    tools.ZJU_MOCAP,
    tools.PROJECTIONS,
    OPENCV_CAMERAS,
)
"""The other tools' files, in any order: all that are found are read, and must agree.

What reads pictures with OpenCV turns them as their EXIF orientation states."""


def recognizes_calibrated(path: Path) -> bool:
    """Whether the folder has a calibration file of another tool that is known here, or one that is refused."""
    return any(True for own in CALIBRATION_FORMATS for _ in own.find(path)) or bool(_pickles(path))


def read_calibrated(path: Path, file: Path | None = None) -> Calibration | None:
    """The cameras of the other tools' calibration file in the folder ``path``; None when there is none."""
    found = [(own, files) for own in CALIBRATION_FORMATS for files in own.find(path)]
    read = [own.read(files) for own, files in found if file is None or file in files]
    if different := [other for other in read[1:] if not _agree(read[0], other)]:
        raise CalibrationError(
            f"{path} has several calibrations that differ, {read[0].where.name} and "
            f"{', '.join(other.where.name for other in different[:3])}; expected that of this take alone: move the "
            "others out of the folder (prepare takes one by --calibration FILE)."
        )
    if read:
        return read[0]
    if pickles := [pickle for pickle in _pickles(path) if file in (None, pickle)]:
        raise CalibrationError(
            f"{pickles[0]} is a pickle, and opening it could run any program; it is refused. "
            "Convert it, with a program that you trust, to one of the formats of docs/captures.md."
        )
    return None


def read_calibration(folder: Path, file: Path | None = None) -> Calibration | None:
    """The calibration in a folder, of COLMAP, transforms.json or another tool, in this order; None without any."""
    model, files = find_model(folder), transforms.find(folder)
    if model is not None and (file is None or file.parent == model):
        return read_model(model)
    if files and (file is None or file in files):
        return transforms.read(files)
    return read_calibrated(folder, file)


def has_calibration(folder: Path) -> bool:
    """Whether :func:`read_calibration` finds or refuses one."""
    return find_model(folder) is not None or bool(transforms.find(folder)) or recognizes_calibrated(folder)


def calibration_below(path: Path) -> Path | None:
    """The one folder in ``path`` that holds the calibration of what was filmed elsewhere in ``path``; None for none.

    It may lie one deeper, as EasyVolcap's ``optimized/cameras``.
    """
    inner = inner_folders(path)
    found = [folder for folder in inner if has_calibration(folder) and not _is_capture(folder)]
    if not found and has_frames(path):
        deeper = [own for folder in inner if not has_files(folder) for own in folders_of(folder)]
        found = [folder for folder in deeper if has_calibration(folder) and not _is_capture(folder)]
    frames = pictures_in(path)
    if found and all(folder.name in frames for folder in found):
        return found[0]  # of the first frame, as 3DGStream has it
    if len(found) > 1:
        names = ", ".join(folder.name for folder in found[:4])
        raise CalibrationError(
            f"{path} has calibrations in several folders ({names}); expected one: move the others out of it."
        )
    return found[0] if found else None


def inner_folders(path: Path) -> list[Path]:
    """The folders in ``path`` that may hold calibrations, in natural order."""
    return folders_of(path, without={*NO_CAMERAS, "sparse", "sparse_"} - {"calibration"})


def _is_capture(folder: Path) -> bool:
    """Whether a folder with a calibration holds frames, and not what the calibration was made from."""
    if "calib" in folder.name.lower():
        return False
    roots = roots_of(folder)
    stills = [root for root in roots if root == folder or root.name.lower() == "images"]
    if any(len(videos_in(root)) > 1 or len(pictures_in(root)) > 1 for root in roots):
        return True
    siblings = pictures_in(folder.parent)
    is_frame = folder.name in siblings and len(siblings) > 1
    return not is_frame and any(files_of(root, PICTURE_SUFFIXES) for root in stills)


def _pickles(path: Path) -> list[Path]:
    return sorted(file for file in path.iterdir() if file.suffix.lower() in PICKLES)


def _agree(a: Calibration, b: Calibration) -> bool:
    """Whether two calibrations have the same cameras up to a motion of the world and its unit of length."""
    first, second = ({camera.name: camera for camera in own.cameras} for own in (a, b))
    if first.keys() != second.keys():
        return False
    names = sorted(first)
    rotations, offsets = zip(*(_relative([own[name] for name in names]) for own in (first, second)))
    K = [np.array([own[name].K for name in names]) for own in (first, second)]
    return bool(
        np.abs(rotations[0] - rotations[1]).max() < SAME_ROTATION
        and np.abs(offsets[0] - offsets[1]).max() < SAME_SHARE
        and np.abs(K[0] - K[1]).max() < SAME_PIXELS
    )


def _relative(cameras: Sequence[PosedCamera]) -> tuple[np.ndarray, np.ndarray]:
    """Rotations ``[V, 3, 3]`` and positions ``[V, 3]`` in the axes of the first camera, in extents of the rig."""
    first = cameras[0].viewmat[:3, :3]
    centers = np.array([camera.center for camera in cameras])
    extent = float(np.linalg.norm(np.ptp(centers, axis=0))) or 1.0
    return np.array([camera.viewmat[:3, :3] @ first.T for camera in cameras]), (centers - centers[0]) @ first.T / extent

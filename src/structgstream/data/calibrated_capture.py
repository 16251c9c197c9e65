# SPDX-License-Identifier: Apache-2.0
"""Captures with a calibration file of another tool beside pictures or videos."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from structgstream.data.calibration_files import (
    anipose,
    cmu_panoptic,
    easymocap,
    kalibr,
    multical,
    opencv_cameras,
    qualisys,
    zju_mocap,
)
from structgstream.data.posed import Calibration
from structgstream.data.posed_capture import open_posed
from structgstream.data.source import FrameSource
from structgstream.errors import CalibrationError

PICKLES = (".pickle", ".pkl")


class Converter(NamedTuple):
    """``find`` gives the sets of files in a folder that are a tool's calibrations, ``parse`` the cameras of one.

    ``turned_by_exif`` is of :class:`~structgstream.data.posed.Calibration`.
    """

    find: Callable[[Path], Iterator[tuple[Path, ...]]]
    parse: Callable[[tuple[Path, ...]], Calibration]
    turned_by_exif: bool | None = None

    def read(self, files: tuple[Path, ...]) -> Calibration:
        """The cameras of a set of files."""
        return replace(self.parse(files), turned_by_exif=self.turned_by_exif)


OF_OPENCV = (anipose, easymocap, multical, opencv_cameras)
"""Tools that read pictures with OpenCV, which turns them as their EXIF orientation says."""
CONVERTERS = tuple(
    Converter(tool.find, tool.read, True if tool in OF_OPENCV else None)
    for tool in (anipose, easymocap, multical, kalibr, cmu_panoptic, qualisys, zju_mocap, opencv_cameras)
)


def recognizes_calibrated(path: Path) -> bool:
    """Whether the folder has a calibration file that is known here, or one that is refused."""
    return _found(path) is not None or bool(_pickles(path))


def open_calibrated(path: Path) -> FrameSource:
    """The capture at ``path``, undistorted.

    Raises:
        CaptureError: no pictures or videos, or not of the calibrated cameras.
        CalibrationError: a broken file, or one that only running it could read.
    """
    if (found := _found(path)) is not None:
        converter, files = found
        return open_posed(path, converter.read(files))
    pickles = _pickles(path)
    raise _refused(pickles[0] if pickles else path)


def read_calibrated(path: Path, file: Path | None = None) -> Calibration | None:
    """The cameras of the calibration file in the folder ``path``; None when there is none.

    Args:
        path: the folder.
        file: the only file to consider; None for any.

    Raises:
        CalibrationError: a broken file, or one that only running it could read.
    """
    for converter in CONVERTERS:
        for files in converter.find(path):
            if file is None or file in files:
                return converter.read(files)
    pickles = [pickle for pickle in _pickles(path) if file in (None, pickle)]
    if pickles:
        raise _refused(pickles[0])
    return None


def _refused(pickle: Path) -> CalibrationError:
    return CalibrationError(
        f"{pickle} is a pickle, and opening it could run any program; it is refused. "
        "Convert it, with a program that you trust, to one of the formats of docs/captures.md."
    )


def _found(path: Path) -> tuple[Converter, tuple[Path, ...]] | None:
    return next(((converter, files) for converter in CONVERTERS for files in converter.find(path)), None)


def _pickles(path: Path) -> list[Path]:
    return sorted(file for file in path.iterdir() if file.suffix.lower() in PICKLES)

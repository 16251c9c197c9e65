# SPDX-License-Identifier: Apache-2.0
"""How calibration files are read: a format, and errors that name file, camera and remedy."""

import logging
import operator
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from structgstream.data.calibration import Calibration, PosedCamera, listed
from structgstream.data.text_files import BROKEN, Unreadable, number, read_text, reason
from structgstream.errors import CalibrationError

Entry = TypeVar("Entry")
log = logging.getLogger(__name__)

LARGEST_BYTES = 50_000_000  # of a file that is searched to recognise it


def json_files_with(folder: Path, key: str) -> Iterator[tuple[Path]]:
    """The JSON files of ``folder`` that contain the quoted ``key``, each alone."""
    for file in sorted(folder.glob("*.json")):
        try:
            if file.stat().st_size < LARGEST_BYTES and f'"{key}"' in read_text(file):
                yield (file,)
        except (OSError, Unreadable):
            continue  # no file of these


@dataclass(frozen=True)
class CalibrationFormat:
    """The calibration files of a tool.

    Args:
        find: gives the sets of files in a folder that are a calibration of the tool each.
        entries: gives the cameras of such a set by name, with what the files state of them.
        camera: makes the camera of an entry.
        expected: what the files contain, for messages.
        turned_by_exif: see :class:`~structgstream.data.calibration.Calibration`.
        where: gives the file or folder that messages name.
    """

    find: Callable[[Path], Iterator[tuple[Path, ...]]]
    entries: Callable[[tuple[Path, ...]], Iterable[tuple[str, Any]]]
    camera: Callable[[str, Any], PosedCamera]
    expected: str
    turned_by_exif: bool | None = None
    where: Callable[[tuple[Path, ...]], Path] = operator.itemgetter(0)

    def read(self, files: tuple[Path, ...]) -> Calibration:
        """The cameras of a set of files.

        Raises:
            CalibrationError: a file is missing or broken, or a camera has a model that is not known here.
            MissingExtraError: a package that parses the files is not installed.
        """
        where = self.where(files)
        with readable(where, self.expected):
            entries = list(self.entries(files))
        calibration = calibration_of(entries, self.camera, file=where, expected=self.expected)
        return replace(calibration, turned_by_exif=self.turned_by_exif)


def common_folder(files: tuple[Path, ...]) -> Path:
    """The one file, or the folder of several."""
    return files[0] if len(files) == 1 else Path(os.path.commonpath(files))


class NoPose(Unreadable):
    """A file has no pose of a camera, since it was not calibrated with the others."""


@contextmanager
def readable(what: Path | str, expected: str) -> Iterator[None]:
    """Converts what the body raises for a broken file to a sentence that states what was expected.

    Args:
        what: the file or its part, for the message.
        expected: what it should contain.

    Raises:
        CalibrationError: it is broken.
        NoPose: the body raised it.
    """
    try:
        with np.errstate(all="ignore"):  # what overflows is not finite, which is refused
            yield
    except (CalibrationError, NoPose):
        raise
    except BROKEN as error:
        raise CalibrationError(f"{what} cannot be read ({reason(error)}); expected {expected}.") from None


def calibration_of(
    entries: Iterable[tuple[str, Entry]], read: Callable[[str, Entry], PosedCamera], *, file: Path, expected: str
) -> Calibration:
    """The cameras of a file, in its order; those without a pose are left out with a warning.

    Raises:
        CalibrationError: an entry is broken, naming its camera; or there is none, or none with a pose.
    """
    cameras, unposed = [], []
    for name, entry in entries:
        try:
            with readable(f"Camera {name!r} of {file}", expected):
                camera = read(name, entry)
                if not (np.isfinite(camera.viewmat).all() and np.isfinite(camera.K).all()):
                    raise Unreadable("a number that is not finite (NaN or infinity)")
            cameras.append(camera)
        except NoPose:
            unposed.append(name)
    if not cameras:
        found = f"no pose of {listed(unposed)}" if unposed else "no cameras"
        raise CalibrationError(f"{file} holds {found}; expected {expected}.")
    if unposed:
        log.warning("%s has no pose of %s; left out", file, listed(unposed))
    return Calibration(file, tuple(cameras), unposed=tuple(unposed))


def read_array(file: Path) -> NDArray[np.float64]:
    """The numbers of an ``.npy`` file.

    Raises:
        Unreadable: it holds something else, or is cut.
        OSError: it cannot be read.
    """
    try:
        return np.asarray(np.load(file, allow_pickle=False), dtype=np.float64)
    except OSError:
        raise
    except Exception:  # a damaged header can raise anything
        raise Unreadable("it is no array of numbers, or is cut") from None


def positive(content: Mapping[str, Any], key: str) -> float:
    """The number of a key.

    Raises:
        Unreadable: it is not positive, or not finite.
    """
    try:
        found = number(content[key])
    except Unreadable as error:
        raise Unreadable(f"{key}: {error}") from None
    if found <= 0:
        raise Unreadable(f"{key} {found:g}")
    return found

# SPDX-License-Identifier: Apache-2.0
"""Broken files become one sentence that names file, camera and remedy."""

import logging
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from structgstream.data.calibration import listed
from structgstream.data.posed import Calibration, PosedCamera
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


class NoPose(Unreadable):
    """A camera of which a file says no pose, since it was not calibrated with the others."""


@contextmanager
def readable(what: Path | str, expected: str) -> Iterator[None]:
    """What the body raises for a broken file, as a sentence that says what it should hold.

    Args:
        what: the file, or what of it is read, for the message.
        expected: what it should hold.

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

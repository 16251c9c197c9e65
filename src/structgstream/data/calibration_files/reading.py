# SPDX-License-Identifier: Apache-2.0
"""Broken files become one sentence that names file, camera and remedy."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from structgstream.data.posed import PosedCamera
from structgstream.errors import CalibrationError

Entry = TypeVar("Entry")
LARGEST_BYTES = 50_000_000  # of a file that is searched to recognise it
BROKEN = (OSError, ValueError, KeyError, TypeError, IndexError, AttributeError)


def json_files_with(folder: Path, key: str) -> Iterator[tuple[Path]]:
    """The JSON files of ``folder`` that contain the quoted ``key``, each alone."""
    for file in sorted(folder.glob("*.json")):
        if file.stat().st_size < LARGEST_BYTES and f'"{key}"'.encode() in file.read_bytes():
            yield (file,)


@contextmanager
def readable(file: Path, expected: str) -> Iterator[None]:
    """What the body raises for a broken file, as a sentence that says what the file should hold.

    Raises:
        CalibrationError: the file is broken.
    """
    try:
        yield
    except CalibrationError:
        raise
    except BROKEN as error:
        raise CalibrationError(f"{file} cannot be read ({reason(error)}); expected {expected}.") from None


def each_camera(
    entries: Iterable[tuple[str, Entry]], read: Callable[[str, Entry], PosedCamera], *, file: Path, expected: str
) -> tuple[PosedCamera, ...]:
    """The cameras of a file, in its order.

    Raises:
        CalibrationError: an entry is broken, naming its camera; or there is none.
    """
    cameras = []
    for name, entry in entries:
        try:
            cameras.append(read(name, entry))
        except CalibrationError:
            raise
        except BROKEN as error:
            raise CalibrationError(
                f"Camera {name!r} of {file} cannot be read ({reason(error)}); expected {expected}."
            ) from None
    if not cameras:
        raise CalibrationError(f"{file} holds no cameras; expected {expected}.")
    return tuple(cameras)


def positive(content: Mapping[str, Any], key: str) -> float:
    """The number of a key.

    Raises:
        ValueError: it is not positive, or not finite.
    """
    number = float(content[key])
    if not 0 < number < math.inf:
        raise ValueError(f"{key} {number:g}")
    return number


def reason(error: Exception) -> str:
    """What was wrong with a file, as a clause of a message."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return f"no {error}" if isinstance(error, KeyError) else f"{type(error).__name__}: {error}"

# SPDX-License-Identifier: Apache-2.0
"""Text that people and other programs wrote: its encoding, its numbers, the paths in it, and what is wrong with it.

Editors of Windows put a byte order mark before UTF-8, its shells write UTF-16, locales write decimal commas, and paths
are those of the machine that wrote the file. Every reader of calibrations and lists takes these functions. They raise
:class:`Unreadable`, or an ``OSError`` of the file itself; :func:`readable` makes one sentence of either.
"""

import json
import math
import os
import re
import struct
import tomllib
import zipfile
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any
from unicodedata import normalize

import numpy as np
from numpy.typing import NDArray

from structgstream.errors import CalibrationError

MAX_PIXELS = 65_535  # of a side of a picture


class Unreadable(ValueError):
    """What is wrong with a file, in words for its user; :func:`reason` repeats them."""


BROKEN = (
    OSError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError, EOFError, RecursionError,
    struct.error, zipfile.BadZipFile,
)  # fmt: skip
"""What reading a broken file raises."""


def read_text(file: Path) -> str:
    """The text of a file in UTF-8, UTF-16 or UTF-32, with or without a byte order mark; lines end with ``\\n``.

    Letters with marks are composed, as :func:`~structgstream.data.camera_files.name_of` has them.
    """
    data = file.read_bytes()
    try:
        text = data.decode(json.detect_encoding(data))
    except UnicodeDecodeError as error:
        place = error.start + len(data) - len(error.object)  # which lacks the mark
        raise Unreadable(f"it is no Unicode text from byte {place} on; save it as UTF-8") from None
    return normalize("NFC", text.replace("\r\n", "\n").replace("\r", "\n"))


def read_json(file: Path) -> Any:
    """The content of a JSON file."""
    text = read_text(file)
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        raise Unreadable(f"it is not JSON from line {error.lineno}, column {error.colno} on") from None
    except (RecursionError, ValueError):
        raise Unreadable("it is not JSON of a calibration") from None


def read_toml(file: Path) -> dict[str, Any]:
    """The content of a TOML file."""
    text = read_text(file)
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        place = re.search(r"at (line \d+, column \d+|end of document)", str(error))
        raise Unreadable(f"it is not TOML at {place[1] if place else 'some place'}") from None
    except (RecursionError, ValueError):
        raise Unreadable("it is not TOML of a calibration") from None


def number(value: Any) -> float:
    """A finite number, also one that was written as text, with a decimal point or comma."""
    try:
        found = float(value.strip().replace(",", ".") if isinstance(value, str) else value)
    except (TypeError, ValueError, OverflowError):
        raise Unreadable(f"{_shown(value)} in place of a number") from None
    if not math.isfinite(found):
        raise Unreadable(f"a number that is not finite ({found:g})")
    return found


def whole(value: Any) -> int:
    """A whole number, as :func:`number`; ``320.0`` is one, too."""
    if not (found := number(value)).is_integer():
        raise Unreadable(f"{_shown(value)} in place of a whole number")
    return int(found)


def positive(content: Mapping[str, Any], key: str) -> float:
    """The number of a key, which is more than 0."""
    try:
        found = number(content[key])
    except Unreadable as error:
        raise Unreadable(f"{key}: {error}") from None
    if found <= 0:
        raise Unreadable(f"{key} {found:g}")
    return found


def pixels(size: Any) -> tuple[int, int]:
    """Width and height of a picture."""
    if isinstance(size, str) or not hasattr(size, "__len__") or len(size) != 2:
        raise Unreadable(f"{_shown(size)} in place of width and height")
    width, height = (round(number(side)) for side in size)
    if not 1 <= min(width, height) <= max(width, height) <= MAX_PIXELS:
        raise Unreadable(f"a picture of {width}x{height} pixels")
    return width, height


def mapping(value: Any) -> dict[str, Any]:
    """Named values."""
    if not isinstance(value, dict):
        raise Unreadable(f"{_shown(value)} in place of names with values")
    return value


def _shown(value: Any) -> str:
    text = "nothing" if value is None else repr(value)
    return text if len(text) <= 40 else f"{text[:40]}..."


def reason(error: Exception) -> str:
    """What was wrong with a file, as a clause of a message, without the words of the language it is read with."""
    if isinstance(error, Unreadable):
        return str(error)
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    if isinstance(error, KeyError) and error.args and isinstance(error.args[0], str | int):
        return f"no {error.args[0]!r}"
    if isinstance(error, struct.error | EOFError):
        return "it is cut"
    return "values are missing, or of another form"


def read_array(file: Path) -> NDArray[np.float64]:
    """The numbers of an ``.npy`` file."""
    try:
        return np.asarray(np.load(file, allow_pickle=False), dtype=np.float64)
    except OSError:
        raise
    except Exception:  # a damaged header can raise anything
        raise Unreadable("it is no array of numbers, or is cut") from None


@contextmanager
def readable(what: Path | str, expected: str) -> Iterator[None]:
    """Converts what the body raises for a broken file to a sentence on ``what``, the file or its part.

    Raises:
        CalibrationError: it is broken, with the reason and what was ``expected``.
    """
    try:
        with np.errstate(all="ignore"):  # what overflows is not finite, which is refused
            yield
    except BROKEN as error:
        raise CalibrationError(f"{what} cannot be read ({reason(error)}); expected {expected}.") from None


def path_parts(text: str) -> tuple[str, ...]:
    """The parts of a path of any system: of ``C:\\data\\cam0\\1.png`` they are ``data``, ``cam0`` and ``1.png``."""
    plain = re.sub(r"^(file://|[A-Za-z]:(?=[\\/]))", "", normalize("NFC", text.strip())).replace("\\", "/")
    return tuple(part for part in PurePosixPath(plain).parts if part not in ("/", "//"))


class NamedFiles:
    """Finds the files of a capture by the paths that another program wrote, perhaps on another machine.

    A path may have backslashes, a drive, folders that are not here, no suffix, or that of the pictures from which those
    here were converted. Folders are listed once each.

    Args:
        folder: that the paths are relative to.
        suffixes: of files that a path without suffix, or with another of these, stands for; lower case.
    """

    def __init__(self, folder: Path, suffixes: Collection[str]) -> None:
        self._folder = folder
        self._suffixes = suffixes
        self._listings: dict[Path, dict[str, list[Path]]] = {}
        self._texts: dict[Path, str] = {}

    def find(self, text: str) -> Path | None:
        """The file that a path means; None where there is none, and ``Unreadable`` where another path means it, too."""
        parts = path_parts(text)
        absolute = re.match(r"\s*(/|\\|file:|[A-Za-z]:[\\/])", text) is not None
        tails = [parts[first:] for first in range(len(parts) if absolute else 1)]
        file = next((file for tail in tails if (file := self._listed(self._folder.joinpath(*tail))) is not None), None)
        if file is not None and self._texts.setdefault(file, text) != text:
            raise Unreadable(f"{self._texts[file]!r} and {text!r} both mean {file.name}")
        return file

    def _listed(self, path: Path) -> Path | None:
        path = Path(os.path.normpath(path))
        if path.parent not in self._listings:
            found = self._listings[path.parent] = {}
            for entry in path.parent.iterdir() if path.parent.is_dir() else ():
                found.setdefault(_stem(entry, self._suffixes), []).append(entry)
        same = self._listings[path.parent].get(_stem(path, self._suffixes), [])
        exact = next((entry for entry in same if normalize("NFC", entry.name) == path.name), None)
        others = [entry for entry in same if entry.suffix.lower() in self._suffixes]
        return exact or (others[0] if len(others) == 1 else None)


def _stem(path: Path, suffixes: Collection[str]) -> str:
    return normalize("NFC", path.stem if path.suffix.lower() in suffixes else path.name)

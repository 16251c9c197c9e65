# SPDX-License-Identifier: Apache-2.0
"""Parsers of calibration files: OpenCV's ``FileStorage``, YAML, and pickled arrays.

OpenCV's own reader of its ``FileStorage`` writes beyond its memory where a file states another size of a matrix than it
holds, and its YAML has a header and a type that other readers do not know: so :func:`read_storage`.

Note [Pickles are programs]
~~~~~~~~~~~~~~~~~~~~~~~~~~~
A pickle names functions and calls them, so that opening one from elsewhere can do whatever its author likes.
Dictionaries, lists, text and numbers need no function; arrays need those of :data:`KNOWN`, which are replaced by ones
that make an empty array, a type of numbers, or text, and nothing else. Any other name ends the reading.
"""

import pickle
import re
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from structgstream.data.text_files import Unreadable, mapping, number, read_json, read_text, whole
from structgstream.errors import CalibrationError, import_extra

LARGEST_BYTES = 50_000_000  # of a file that is searched to recognise it


def recognized(files: Iterable[Path], test: Callable[[Path], object]) -> Iterator[Path]:
    """The files that pass a test, sorted; not those that are large, or that it cannot read."""
    for file in sorted(files):
        with suppress(OSError, Unreadable):
            if file.is_file() and file.stat().st_size < LARGEST_BYTES and test(file):
                yield file


def json_files_with(folder: Path, key: str) -> Iterator[tuple[Path]]:
    """The JSON files of ``folder`` that contain the quoted ``key``, each alone."""
    return ((file,) for file in recognized(folder.glob("*.json"), lambda file: f'"{key}"' in read_text(file)))


MAX_ENTRIES = 1_000_000  # of a matrix
PLAIN_JSON = re.compile(r'"(camera_?matrix|K|mtx|intrinsics?)"', re.IGNORECASE)
"""What a program that writes OpenCV's matrices as lists calls the first of them."""


def may_be_storage(file: Path) -> bool:
    """Whether a file may be one of these, or plain YAML of the same keys."""
    try:
        text = read_text(file)
    except (OSError, Unreadable):
        return False
    if file.suffix.lower() == ".json":
        return '"opencv-matrix"' in text or PLAIN_JSON.search(text) is not None
    return "<opencv_storage" in text[:400] or (file.suffix.lower() != ".xml" and len(text) > 0)


def read_storage(file: Path) -> dict[str, Any]:
    """Everything in the file: matrices as arrays, maps, lists, and text, also that of numbers."""
    text = read_text(file)
    if "<opencv_storage" in text[:400]:
        return {child.tag: _value(_element(child)) for child in parsed_xml(text.strip())}
    return mapping(_value(read_json(file) if text.lstrip().startswith("{") else parsed_yaml(text)))


def parsed_yaml(text: str) -> Any:
    """The content of YAML, with or without OpenCV's header; every scalar is text."""
    yaml = import_extra("yaml", "capture")
    loader = getattr(yaml, "CBaseLoader", yaml.BaseLoader)
    try:
        return yaml.load(re.sub(r"\A\s*%YAML:?.*", "", text), loader)
    except yaml.MarkedYAMLError as error:
        line = f" at line {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise Unreadable(f"it is not YAML{line}") from None
    except (yaml.YAMLError, ValueError, TypeError, RecursionError):
        raise Unreadable("it is not YAML") from None


def parsed_xml(text: str | bytes) -> ET.Element:
    """The root of XML."""
    try:
        return ET.fromstring(text)
    except (ET.ParseError, ValueError) as error:
        line = f" at line {error.position[0]}" if isinstance(error, ET.ParseError) else ""
        raise Unreadable(f"it is not XML{line}") from None


def _element(tag: ET.Element) -> Any:
    children = list(tag)
    if children and all(child.tag == "_" for child in children):
        return [_element(child) for child in children]
    if children:
        return {child.tag: _element(child) for child in children}
    text = (tag.text or "").strip()
    if text.startswith('"'):
        return text.strip('"')
    words = text.split()
    return words if len(words) > 1 else text


def _value(found: Any) -> Any:
    """The same with matrices as arrays."""
    if isinstance(found, list):
        return [_value(entry) for entry in found]
    if not isinstance(found, dict):
        return found
    if {"rows", "cols", "data"} <= found.keys():
        return _matrix(found)
    return {str(key): _value(entry) for key, entry in found.items()}


def _matrix(found: Mapping[str, Any]) -> np.ndarray:
    """``[rows, cols]``, or ``[rows, cols, channels]`` of several channels."""
    rows, columns = whole(found["rows"]), whole(found["cols"])
    data = [found["data"]] if isinstance(found["data"], str) else found["data"]
    values = [number(entry) for entry in data if entry != ""]
    if not 0 <= rows * columns <= MAX_ENTRIES or min(rows, columns) < 0:
        raise Unreadable(f"a matrix of {rows}x{columns}")
    if rows * columns == 0:
        return np.empty((rows, columns))
    channels, rest = divmod(len(values), rows * columns)
    if rest or not channels:
        raise Unreadable(f"a matrix of {rows}x{columns} with {len(values)} numbers")
    return np.array(values).reshape((rows, columns, channels) if channels > 1 else (rows, columns))


class _Refused(pickle.UnpicklingError):
    """It asks for what is not known."""


class _Arrays(pickle.Unpickler):
    """See Note [Pickles are programs]."""

    def find_class(self, module: str, name: str, /) -> Any:
        """The stand-in for a function of numpy."""
        if (known := KNOWN.get((module.replace("numpy._core", "numpy.core"), name))) is None:
            raise _Refused(f"it asks for {module}.{name}")
        return known


class _Type:
    """Stands for ``numpy.ndarray`` and cannot be called."""


def _empty_array(kind: Any, shape: Any, code: Any) -> np.ndarray:
    del kind, shape, code  # __setstate__ follows with the content
    return np.empty(0)


def _number(kind: np.dtype, data: bytes) -> Any:
    if kind.hasobject:
        raise _Refused("it has a number that is an object")
    return np.frombuffer(data, kind, count=1)[0]


def _text(text: str, coding: str) -> bytes:
    if coding != "latin1":
        raise _Refused(f"it has text of the coding {coding}")
    return text.encode(coding)


KNOWN = {
    ("numpy.core.multiarray", "_reconstruct"): _empty_array,
    ("numpy.core.multiarray", "scalar"): _number,
    ("numpy", "ndarray"): _Type,
    ("numpy", "dtype"): np.dtype,
    ("_codecs", "encode"): _text,
}


def load_plain(file: Path) -> Any:
    """The object of an ``.npy`` file of dictionaries, lists, text, numbers and arrays of them.

    Raises:
        CalibrationError: it holds anything else.
    """
    with file.open("rb") as stream:
        try:
            version = np.lib.format.read_magic(stream)
            header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            if not header(stream)[2].hasobject:
                raise Unreadable("it is an array of numbers")
            return _Arrays(stream, encoding="latin1").load()
        except _Refused as error:
            raise CalibrationError(
                f"{file} is a pickle that holds more than arrays ({error}), and opening it could run any program; "
                "it is refused. Convert it, with a program that you trust, to one of the formats of docs/captures.md."
            ) from None
        except Unreadable:
            raise
        except Exception:  # a cut or forged one can raise anything
            raise Unreadable("it is cut or damaged") from None

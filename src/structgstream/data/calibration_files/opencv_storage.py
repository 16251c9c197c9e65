# SPDX-License-Identifier: Apache-2.0
"""Reads what OpenCV's ``FileStorage`` writes, YAML, XML or JSON: matrices as arrays, all else as text, lists and names.

OpenCV's own reader writes beyond its memory where a file states another size of a matrix than it holds, and its YAML is
of a header and a type that other readers do not know.
"""

import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from structgstream.data.text_files import Unreadable, mapping, number, read_json, read_text, whole
from structgstream.errors import MissingExtraError

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
    """Everything in the file: matrices as arrays, maps, lists, and text, also that of numbers.

    Raises:
        Unreadable: it cannot be parsed, or a matrix has not as many numbers as it states.
        OSError: it cannot be read.
        MissingExtraError: PyYAML is not installed.
    """
    text = read_text(file)
    if "<opencv_storage" in text[:400]:
        return _of_xml(text)
    return mapping(_value(read_json(file) if text.lstrip().startswith("{") else parsed_yaml(text)))


def parsed_yaml(text: str) -> Any:
    """The content of YAML, with or without OpenCV's header; every scalar is text.

    Raises:
        Unreadable: it is not YAML.
        MissingExtraError: PyYAML is not installed.
    """
    try:
        import yaml
    except ImportError:
        raise MissingExtraError("yaml", "capture") from None
    loader = getattr(yaml, "CBaseLoader", yaml.BaseLoader)
    try:
        return yaml.load(re.sub(r"\A\s*%YAML:?.*", "", text), loader)
    except yaml.MarkedYAMLError as error:
        line = f" at line {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise Unreadable(f"it is not YAML{line}") from None
    except (yaml.YAMLError, ValueError, TypeError, RecursionError):
        raise Unreadable("it is not YAML") from None


def _of_xml(text: str) -> dict[str, Any]:
    try:
        root = ET.fromstring(text.strip())
    except (ET.ParseError, ValueError) as error:
        line = f" at line {error.position[0]}" if isinstance(error, ET.ParseError) else ""
        raise Unreadable(f"it is not XML{line}") from None
    return {child.tag: _value(_element(child)) for child in root}


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

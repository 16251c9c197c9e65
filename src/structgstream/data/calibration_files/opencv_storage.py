# SPDX-License-Identifier: Apache-2.0
"""Reads what OpenCV's ``FileStorage`` writes, YAML or XML, whose matrices no other reader of these knows."""

import re
from pathlib import Path
from types import ModuleType
from typing import Any

from structgstream.data.images import opencv
from structgstream.data.text_files import Unreadable, read_text

DECIMAL_COMMA = re.compile(r"(?<=\d),(?=\d)")


def is_storage(file: Path) -> bool:
    """Whether a file begins as one of these."""
    try:
        head = read_text(file)[:400].lstrip()
    except (OSError, Unreadable):
        return False
    return head.startswith("%YAML") or "<opencv_storage" in head


def read_storage(file: Path) -> dict[str, Any]:
    """Everything in the file: matrices as arrays, maps, lists, numbers, text.

    Raises:
        Unreadable: it cannot be parsed.
        OSError: it cannot be read.
    """
    cv2 = opencv()
    text = read_text(file)
    if "<opencv_storage" in text:
        text = re.sub(r"<data>[^<]*", lambda data: DECIMAL_COMMA.sub(".", data[0]), text)
    try:
        storage = cv2.FileStorage(text.lstrip(), cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        try:
            root = storage.root()
            return {key: _value(cv2, storage.getNode(key)) for key in root.keys()}  # noqa: SIM118
        finally:
            storage.release()
    except (cv2.error, SystemError, UnicodeError) as error:
        place = re.search(r"\((\d+)\): ", str(error).replace("\n", " "))
        raise Unreadable(f"OpenCV cannot parse it{f' at line {place[1]}' if place else ''}") from None


def _value(cv2: ModuleType, node: Any) -> Any:
    if node.isInt():
        return int(node.real())
    if node.isReal():
        return node.real()
    if node.isString():
        return node.string()
    if node.isMap():
        keys = node.keys()
        if {"rows", "cols", "data"} <= set(keys):
            return node.mat()
        return {key: _value(cv2, node.getNode(key)) for key in keys}
    if node.isSeq():
        return [_value(cv2, node.at(index)) for index in range(node.size())]
    return None

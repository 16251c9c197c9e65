# SPDX-License-Identifier: Apache-2.0
"""Reads what OpenCV's ``FileStorage`` writes, YAML or XML, whose matrices no other reader of these knows."""

from pathlib import Path
from types import ModuleType
from typing import Any

from structgstream.data.images import opencv


def is_storage(file: Path) -> bool:
    """Whether a file begins as one of these."""
    with file.open("rb") as stream:
        head = stream.read(400)
    return head.startswith(b"%YAML") or b"<opencv_storage" in head


def read_storage(file: Path) -> dict[str, Any]:
    """Everything in the file: matrices as arrays, maps, lists, numbers, text.

    Raises:
        ValueError: it cannot be parsed.
        OSError: it cannot be read.
    """
    cv2 = opencv()
    text = file.read_text()  # in place of OpenCV's own message for a file that is not there
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    except (cv2.error, SystemError) as error:
        raise ValueError(f"OpenCV cannot parse it, {str(error).strip().splitlines()[-1]}") from None
    try:
        root = storage.root()
        return {key: _value(cv2, storage.getNode(key)) for key in root.keys()}  # noqa: SIM118
    finally:
        storage.release()


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

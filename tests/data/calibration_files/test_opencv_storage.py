# SPDX-License-Identifier: Apache-2.0
"""What OpenCV writes is read as plain values."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from structgstream.data.calibration_files.reading import may_be_storage, read_storage
from structgstream.data.text_files import Unreadable

MATRIX = np.arange(6.0).reshape(2, 3)


def written(path: Path) -> Path:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("K", MATRIX)
    storage.write("count", 3)
    storage.write("error", 0.25)
    storage.write("name", "cam 1")
    storage.startWriteStruct("list", cv2.FILE_NODE_SEQ)
    for value in ("a", "b"):
        storage.write("", value)
    storage.endWriteStruct()
    storage.startWriteStruct("inner", cv2.FILE_NODE_MAP)
    storage.write("T", MATRIX.T)
    storage.write("rows", 7)
    storage.endWriteStruct()
    storage.release()
    return path


@pytest.mark.parametrize("name", ["rig.yml", "rig.yaml", "rig.xml"])
def test_every_kind_of_value_comes_back(tmp_path: Path, name: str) -> None:
    file = written(tmp_path / name)
    assert may_be_storage(file)
    found = read_storage(file)
    assert set(found) == {"K", "count", "error", "name", "list", "inner"}
    np.testing.assert_array_equal(found["K"], MATRIX)
    np.testing.assert_array_equal(found["inner"]["T"], MATRIX.T)
    assert (found["count"], found["error"], found["name"], found["list"]) == ("3", "0.25", "cam 1", ["a", "b"])
    assert found["inner"]["rows"] == "7"  # a number of that name makes no matrix


def test_other_files(tmp_path: Path) -> None:
    for name, content in (("x.yml", b""), ("x.xml", b"<a/>"), ("x.json", b"{}"), ("x.yml", b"\xff\xfe")):
        (tmp_path / name).write_bytes(content)
        assert not may_be_storage(tmp_path / name)
    (tmp_path / "x.yml").write_text("%YAML:1.0\n---\nK: !!opencv-matrix\n   rows: 3\n   cols: [\n")
    with pytest.raises(Unreadable, match="it is not YAML at line 6"):
        read_storage(tmp_path / "x.yml")
    with pytest.raises(FileNotFoundError):
        read_storage(tmp_path / "none.yml")


@pytest.mark.parametrize(
    ("size", "reported"), [((3, 3), "3x3 with 6 numbers"), ((9999, 9999), "9999x9999"), ((-2, -3), "-2x-3")]
)
def test_matrices_of_another_size_than_stated(tmp_path: Path, size: tuple[int, int], reported: str) -> None:
    """OpenCV writes beyond its memory here."""
    file = written(tmp_path / "rig.yml")
    text = file.read_text().replace("rows: 2", f"rows: {size[0]}", 1).replace("cols: 3", f"cols: {size[1]}", 1)
    file.write_text(text)
    with pytest.raises(Unreadable, match=f"a matrix of {reported}"):
        read_storage(file)


def test_decimal_commas_of_xml(tmp_path: Path) -> None:
    file = tmp_path / "rig.xml"
    file.write_text(
        '<?xml version="1.0"?>\n<opencv_storage><K type_id="opencv-matrix"><rows>1</rows><cols>2</cols><dt>d</dt>'
        "<data>\n 0,5 -1,25e1</data></K></opencv_storage>"
    )
    np.testing.assert_array_equal(read_storage(file)["K"], [[0.5, -12.5]])

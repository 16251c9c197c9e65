# SPDX-License-Identifier: Apache-2.0
"""What OpenCV writes is read as plain values."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from structgstream.data.calibration_files.opencv_storage import is_storage, read_storage

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
    assert is_storage(file)
    found = read_storage(file)
    assert set(found) == {"K", "count", "error", "name", "list", "inner"}
    np.testing.assert_array_equal(found["K"], MATRIX)
    np.testing.assert_array_equal(found["inner"]["T"], MATRIX.T)
    assert (found["count"], found["error"], found["name"], found["list"]) == (3, 0.25, "cam 1", ["a", "b"])
    assert isinstance(found["count"], int)
    assert found["inner"]["rows"] == 7  # a number of that name makes no matrix


def test_other_files(tmp_path: Path) -> None:
    for content in (b"", b"cameras: 1\n", b"{}", b"\xff\xfe"):
        (tmp_path / "x.yml").write_bytes(content)
        assert not is_storage(tmp_path / "x.yml")
    (tmp_path / "x.yml").write_text("%YAML:1.0\n---\nK: !!opencv-matrix\n   rows: 3\n   cols: [\n")
    with pytest.raises(ValueError, match="OpenCV cannot parse it"):
        read_storage(tmp_path / "x.yml")
    with pytest.raises(FileNotFoundError):
        read_storage(tmp_path / "none.yml")

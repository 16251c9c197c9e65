# SPDX-License-Identifier: Apache-2.0
"""Files that are whole or not there."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from structgstream.errors import StorageError
from structgstream.exporters.whole_file import write_whole


def test_parts_follow_each_other_and_folders_are_made(tmp_path: Path) -> None:
    path = tmp_path / "a" / "b" / "c.bin"
    write_whole(path, [b"one", memoryview(b"two"), b""])
    assert path.read_bytes() == b"onetwo"
    assert [entry.name for entry in path.parent.iterdir()] == ["c.bin"]


def test_what_was_there_stays_until_the_new_file_is_whole(tmp_path: Path) -> None:
    def parts() -> Iterator[bytes]:
        yield b"new"
        raise KeyboardInterrupt

    path = tmp_path / "c.bin"
    path.write_bytes(b"old")
    with pytest.raises(KeyboardInterrupt):
        write_whole(path, parts())
    assert path.read_bytes() == b"old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["c.bin"]


def test_a_place_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(StorageError, match=r"file is a file"):
        write_whole(tmp_path / "file" / "x", [b""])

# SPDX-License-Identifier: Apache-2.0
"""Files that have their name only when they are whole."""

from pathlib import Path

import pytest

from structgstream.errors import StorageError
from structgstream.groups.growing_file import GrowingFile, partial_path, whole_file, write_whole


def test_it_grows_under_another_name_and_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "a"
    file = GrowingFile(path)
    file.append(b"one")
    file.append(b"two")
    file.close()
    assert not path.exists()
    again = GrowingFile(path, keep=3)
    again.append(b"TWO")
    again.finish()
    assert path.read_bytes() == b"oneTWO"
    assert [*tmp_path.iterdir()] == [path]


def test_two_writers_do_not_mix(tmp_path: Path) -> None:
    first = GrowingFile(tmp_path / "a")
    first.append(b"one")
    with pytest.raises(StorageError, match="Another process writes"):
        GrowingFile(tmp_path / "a")
    first.append(b"two")
    first.close()
    assert partial_path(tmp_path / "a").read_bytes() == b"onetwo"


def test_a_file_that_has_become_shorter_is_not_continued(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match="has changed"):
        GrowingFile(tmp_path / "a", keep=5)


def test_a_whole_file_is_written_or_not(tmp_path: Path) -> None:
    path = tmp_path / "a"
    write_whole(path, b"old")
    with pytest.raises(RuntimeError), whole_file(path) as file:  # noqa: PT012
        file.write(b"new")
        raise RuntimeError
    assert path.read_bytes() == b"old"
    assert [*tmp_path.iterdir()] == [path]
    with pytest.raises(StorageError, match="cannot be written"):
        write_whole(tmp_path / "none" / "a", b"")

# SPDX-License-Identifier: Apache-2.0
"""Files that have their name only when they are whole."""

import os
from pathlib import Path

import pytest

from structgstream.atomic_files import GrowingFile, partial_path
from structgstream.errors import StorageError


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


def test_what_another_process_has_finished_meanwhile_is_not_cut_off(tmp_path: Path) -> None:
    """It has been opened under its other name just before that."""
    path = tmp_path / "a"
    partial_path(path).write_bytes(b"one")
    opened = os.open

    def slow(name: Path, flags: int, mode: int = 0o777) -> int:
        descriptor = opened(name, flags, mode)
        if partial_path(path).exists() and not path.exists():
            partial_path(path).rename(path)
        return descriptor

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "open", slow)
        with pytest.raises(StorageError, match="Another process has changed"):
            GrowingFile(path, keep=2)
    assert path.read_bytes() == b"one"


def test_its_folder_is_created_or_reported(tmp_path: Path) -> None:
    GrowingFile(tmp_path / "new" / "folder" / "a").close()
    assert partial_path(tmp_path / "new" / "folder" / "a").exists()
    (tmp_path / "file").touch()
    with pytest.raises(StorageError, match="cannot be written"):
        GrowingFile(tmp_path / "file" / "a")

# SPDX-License-Identifier: Apache-2.0
"""Files that have their name only when they are whole."""

import os
from pathlib import Path

import pytest

from structgstream.atomic_files import GrowingFile, name_finished, partial_path
from structgstream.errors import StorageError
from tests.support.killed import folders_of_the_killed


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


def test_killed_at_any_step_of_finishing_nothing_is_lost_and_it_can_be_finished(tmp_path: Path) -> None:
    def begin(folder: Path) -> None:
        partial_path(folder / "a").write_bytes(b"one")

    def finish(folder: Path) -> None:
        file = GrowingFile(folder / "a", keep=3)
        file.append(b"two")
        file.finish()

    for folder in folders_of_the_killed(tmp_path, finish, begin=begin):
        path, partial = folder / "a", partial_path(folder / "a")
        if path.exists():
            assert path.read_bytes() == b"onetwo"
            assert not partial.exists()
        elif partial.read_bytes() == b"onetwo":
            name_finished(path)
        else:
            assert partial.read_bytes() == b"one"
            finish(folder)
        assert [(entry.name, entry.read_bytes()) for entry in folder.iterdir()] == [("a", b"onetwo")]


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

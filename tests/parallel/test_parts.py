# SPDX-License-Identifier: Apache-2.0
"""Notes are believed only for what is there as it was; torn ones are passed over."""

from pathlib import Path

import pytest

from structgstream.errors import StorageError
from structgstream.executors.task import Ending
from structgstream.parallel.parts import Parts, read_notes


@pytest.fixture
def parts(tmp_path: Path) -> Parts:
    made = Parts(tmp_path / "parts")
    with made.held():
        made.header.write_bytes(b"header")
        made.note(Ending("header", 0, 2.5, 3, 1000), "key", made.header, frames=1)
    return made


def test_a_note_is_read_again(parts: Parts) -> None:
    note = Parts(parts.folder).notes["header"]
    assert (note.seconds, note.attempts, note.peak_bytes, note.bytes, note.frames) == (2.5, 3, 1000, 6, 1)


def test_what_was_only_found_whole_keeps_what_it_took(parts: Parts) -> None:
    parts.note(Ending("header", 0, 0.1), "key", parts.header, frames=1)
    assert Parts(parts.folder).notes["header"].seconds == 2.5


def test_whole_is_the_same_task_and_the_same_bytes(parts: Parts) -> None:
    assert parts.is_whole("header", "key", parts.header)
    assert not parts.is_whole("header", "another key", parts.header)
    assert not parts.is_whole("track", "key", parts.header)
    parts.header.write_bytes(b"Header")
    assert not parts.is_whole("header", "key", parts.header)
    parts.header.unlink()
    assert not parts.is_whole("header", "key", parts.header)


def test_torn_notes_are_passed_over(parts: Parts) -> None:
    path = parts.folder / "done.jsonl"
    path.write_text(path.read_text() + '{"name": "track", "key"\nnot JSON\n{"name": "other"}\n')
    assert set(read_notes(parts.folder)) == {"header"}


def test_cleared_is_empty(parts: Parts) -> None:
    with parts.held():
        parts.clear()
        assert [path.name for path in parts.folder.rglob("*")] == [".driver", "segments"]
    assert not parts.notes


def test_a_folder_that_cannot_be_made_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(StorageError, match="parts cannot be made"), Parts(tmp_path / "file" / "parts").held():
        pass

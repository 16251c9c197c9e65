# SPDX-License-Identifier: Apache-2.0
"""Notes are believed only for what is there as it was; torn ones are passed over."""

import shutil
from pathlib import Path

import pytest

from structgstream.errors import ConfigError, StorageError
from structgstream.executors.tasks import TaskResult
from structgstream.owned_folders import MARKER
from structgstream.parallel.parts import Parts, read_completed
from tests.support.killed import folders_of_the_killed


@pytest.fixture
def parts(tmp_path: Path) -> Parts:
    made = Parts(tmp_path / "parts")
    with made.locked():
        made.header.write_bytes(b"header")
        made.record(TaskResult("header", 0, 2.5, 3, 1000), "key", made.header, frames=1)
    return made


def test_a_note_is_read_again(parts: Parts) -> None:
    note = Parts(parts.folder).completed["header"]
    assert (note.seconds, note.attempts, note.peak_bytes, note.bytes, note.frames) == (2.5, 3, 1000, 6, 1)


def test_what_was_only_found_whole_keeps_what_it_took(parts: Parts) -> None:
    parts.record(TaskResult("header", 0, 0.1), "key", parts.header, frames=1)
    assert Parts(parts.folder).completed["header"].seconds == 2.5


def test_whole_is_the_same_task_and_the_same_bytes(parts: Parts) -> None:
    assert parts.is_complete("header", "key", parts.header)
    assert not parts.is_complete("header", "another key", parts.header)
    assert not parts.is_complete("track", "key", parts.header)
    parts.header.write_bytes(b"Header")
    assert not parts.is_complete("header", "key", parts.header)
    parts.header.unlink()
    assert not parts.is_complete("header", "key", parts.header)


def test_torn_notes_are_passed_over(parts: Parts) -> None:
    path = parts.folder / "done.jsonl"
    path.write_text(path.read_text() + '{"name": "track", "key"\nnot JSON\n{"name": "other"}\n')
    assert set(read_completed(parts.folder)) == {"header"}


def test_killed_at_any_step_of_a_note_the_notes_are_those_before_or_one_more(tmp_path: Path, parts: Parts) -> None:
    """And the next note is not lost, as it was when it was appended to a line that a kill had cut."""

    def noted(folder: Path) -> None:
        Parts(folder).record(TaskResult("track", 0, 1.0), "key", folder / "header.sgs", frames=5)

    def begin(folder: Path) -> None:
        shutil.copytree(parts.folder, folder, dirs_exist_ok=True)

    for folder in folders_of_the_killed(tmp_path, noted, begin=begin):
        assert set(read_completed(folder)) in ({"header"}, {"header", "track"})
        noted(folder)
        assert set(read_completed(folder)) == {"header", "track"}


def test_killed_at_any_step_of_clearing_what_is_left_is_refused_as_before_or_nothing(
    tmp_path: Path, parts: Parts
) -> None:
    parts.use_plan({"capture": "old"})

    def cleared(folder: Path) -> None:
        with Parts(folder).locked():
            Parts(folder).clear()

    def begin(folder: Path) -> None:
        shutil.copytree(parts.folder, folder, dirs_exist_ok=True)

    for folder in folders_of_the_killed(tmp_path, cleared, begin=begin):
        left = Parts(folder)
        if left.header.exists():
            with pytest.raises(ConfigError, match="has parts of another run"):
                left.use_plan({"capture": "new"})
        assert not left.completed or left.header.exists()


def test_cleared_is_empty(parts: Parts) -> None:
    with parts.locked():
        parts.clear()
        assert sorted(path.name for path in parts.folder.rglob("*")) == [".driver", "segments", MARKER]
    assert not parts.completed


def test_what_others_have_put_beside_the_parts_stays(parts: Parts) -> None:
    others = ["mine.txt", "header.txt", "segments/mine.sgs", "logs/diary.txt", "deep/down/plan.json"]
    for name in others:
        (parts.folder / name).parent.mkdir(parents=True, exist_ok=True)
        (parts.folder / name).write_text("mine")
    (parts.folder / "header.log.jsonl").symlink_to(parts.folder / "mine.txt")
    with parts.locked():
        parts.clear()
    assert all((parts.folder / name).read_text() == "mine" for name in others)
    assert not parts.header.exists()
    assert not (parts.folder / "header.log.jsonl").exists()


def test_a_folder_that_is_not_of_parts_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "out.sgs.parts"
    (folder / "segments").mkdir(parents=True)
    (folder / "plan.json").write_text("{}")
    with pytest.raises(StorageError, match="somebody else's; nothing in it was changed"), Parts(folder).locked():
        pass
    with pytest.raises(StorageError, match="somebody else's"):
        Parts(folder).clear()
    assert (folder / "plan.json").read_text() == "{}"
    assert not (folder / MARKER).exists()


def test_a_run_that_begins_anew_has_another_name(parts: Parts) -> None:
    parts.use_plan({"capture": "a"})
    first = parts.run
    parts.use_plan({"capture": "a"})
    assert parts.run == first != ""
    with parts.locked():
        parts.clear()
    parts.use_plan({"capture": "a"})
    assert parts.run not in ("", first)


def test_a_folder_that_cannot_be_made_is_reported(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with (
        pytest.raises(StorageError, match="cannot be used for the parts of a parallel run"),
        Parts(tmp_path / "file" / "parts").locked(),
    ):
        pass

# SPDX-License-Identifier: Apache-2.0
"""Files that are whole or not there, whatever is killed or refused; files that grow; locks."""

import errno
import os
import stat
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Literal

import pytest

from structgstream.atomic_files import (
    GrowingFile,
    atomic_file,
    atomic_write,
    give_name,
    lock_file,
    open_lockable,
    partial_path,
    remove_unused,
    replacing,
    sync_folder,
)
from structgstream.errors import StorageError
from tests.support.killed import folders_of_the_killed

OLD, NEW = b"old", b"new and longer"


def refuse(number: int) -> Callable[..., object]:
    def refused(*arguments: object, **options: object) -> None:
        raise OSError(number, os.strerror(number))

    return refused


def test_pieces_follow_each_other_and_a_folder_is_made_when_asked(tmp_path: Path) -> None:
    path = tmp_path / "a" / "b" / "c.bin"
    atomic_write(path, [b"one", memoryview(b"two"), b""], new_folder=True)
    assert path.read_bytes() == b"onetwo"
    assert [entry.name for entry in path.parent.iterdir()] == ["c.bin"]
    with pytest.raises(StorageError, match=r"other/x cannot be written \(No such file or directory\)\.$"):
        atomic_write(tmp_path / "other" / "x", NEW)


@pytest.mark.parametrize("there", [False, True])
def test_killed_at_any_step_a_file_is_the_old_one_or_the_new_one(tmp_path: Path, there: bool) -> None:
    def begin(folder: Path) -> None:
        if there:
            (folder / "a").write_bytes(OLD)

    killed = folders_of_the_killed(tmp_path, lambda folder: atomic_write(folder / "a", [NEW] * 1000), begin=begin)
    found = [(folder / "a").read_bytes() if (folder / "a").exists() else None for folder in killed]
    before = OLD if there else None
    first_new = found.index(NEW * 1000)
    assert found == [before] * first_new + [NEW * 1000] * (len(found) - first_new)
    assert first_new >= 3, "as before, opened, written"
    for folder in killed:
        atomic_write(folder / "a", NEW)  # What was left is in nobody's way.
        assert [(entry.name, entry.read_bytes()) for entry in folder.iterdir()] == [("a", NEW)]


def test_content_and_folder_are_synced_before_and_after_the_rename(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without the first a file may be empty after a power cut, without the second it may be gone."""
    steps: list[str] = []
    fsync, replace = os.fsync, Path.replace

    def synced(descriptor: int) -> None:
        steps.append("sync folder" if stat.S_ISDIR(os.fstat(descriptor).st_mode) else "sync file")
        fsync(descriptor)

    def replaced(self: Path, target: Path) -> Path:
        steps.append("rename")
        return replace(self, target)

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(Path, "replace", replaced)
    atomic_write(tmp_path / "a", NEW)
    partial_path(tmp_path / "b").write_bytes(NEW)
    give_name(partial_path(tmp_path / "b"), tmp_path / "b")
    assert steps == ["sync file", "rename", "sync folder"] * 2
    atomic_write(tmp_path / "c", NEW, sync=False)
    assert steps[6:] == ["rename"]


@pytest.mark.parametrize("ended", [KeyboardInterrupt, RuntimeError, OSError])
def test_what_ends_the_writing_leaves_what_was_there_and_nothing_else(
    tmp_path: Path, ended: type[BaseException]
) -> None:
    def pieces() -> Iterator[bytes]:
        yield NEW
        raise ended

    path = tmp_path / "a"
    path.write_bytes(OLD)
    with pytest.raises(StorageError if ended is OSError else ended):
        atomic_write(path, pieces())
    with pytest.raises(ended), replacing(path) as file:  # noqa: PT012
        file.write(NEW)
        raise ended
    assert [(entry.name, entry.read_bytes()) for entry in tmp_path.iterdir()] == [("a", OLD)]


@pytest.mark.parametrize(
    ("number", "reported"),
    [
        (errno.ENOSPC, r"\(No space left on device\); make room\."),
        (errno.EDQUOT, r"\(Disk quota exceeded\); make room\."),
        (errno.EIO, r"\(Input/output error\)\."),
    ],
)
@pytest.mark.parametrize("step", ["os.fsync", "pathlib.Path.replace"])
def test_a_disk_that_fails_at_a_step_is_reported_and_leaves_what_was_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, reported: str, step: str
) -> None:
    (tmp_path / "a").write_bytes(OLD)
    with monkeypatch.context() as patch:
        patch.setattr(step, refuse(number))
        with pytest.raises(StorageError, match=rf"^The picture .*a cannot be written {reported}$"):
            atomic_write(tmp_path / "a", NEW, called="The picture")
    assert [(entry.name, entry.read_bytes()) for entry in tmp_path.iterdir()] == [("a", OLD)]


def test_a_device_stays_one(tmp_path: Path) -> None:
    """Of ``--json /dev/stdout`` root would make a file."""
    path = tmp_path / "a"
    path.symlink_to("/dev/null")
    atomic_write(path, NEW)
    assert path.is_char_device()
    assert [entry.name for entry in tmp_path.iterdir()] == ["a"]


def test_a_pipe_gets_what_is_written(tmp_path: Path) -> None:
    path = tmp_path / "a"
    os.mkfifo(path)
    reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    try:
        atomic_write(path, NEW)
        assert os.read(reader, 100) == NEW
    finally:
        os.close(reader)
    assert path.is_fifo()


def test_a_link_stays_one(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "a").symlink_to(tmp_path / "folder" / "file")
    for content in (OLD, NEW):
        atomic_write(tmp_path / "a", content)
        assert (tmp_path / "a").is_symlink()
        assert [(each.name, each.read_bytes()) for each in (tmp_path / "folder").iterdir()] == [("file", content)]


def test_a_real_disk_without_room(tmp_path: Path) -> None:
    """``/dev/full`` in the place of the file that is written."""
    if not os.access("/dev/full", os.W_OK):
        pytest.skip("this system has no /dev/full")
    (tmp_path / "a").write_bytes(OLD)
    partial_path(tmp_path / "a").symlink_to("/dev/full")
    with pytest.raises(StorageError, match="a cannot be written"):
        atomic_write(tmp_path / "a", NEW)
    assert (tmp_path / "a").read_bytes() == OLD
    assert [entry.name for entry in tmp_path.iterdir()] == ["a"]


def test_a_folder_without_permission_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "open", refuse(errno.EACCES))  # root may write anywhere
    with pytest.raises(StorageError, match=r"denied\); correct its permissions, or choose another place\.$"):
        atomic_write(tmp_path / "a", NEW)


def test_what_is_in_the_place_of_the_folder_or_the_file_is_reported(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(StorageError, match=r"file/x cannot be written \(.*file is a file\)\.$"):
        atomic_write(tmp_path / "file" / "x", b"", new_folder=True)
    (tmp_path / "taken").mkdir()
    with pytest.raises(StorageError, match=r"taken cannot be written \(Is a directory\)"):
        atomic_write(tmp_path / "taken", NEW)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["file", "taken"]


@pytest.mark.parametrize("number", [errno.EINVAL, errno.ENOTSUP])
def test_a_file_system_that_cannot_sync_folders_gets_its_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    fsync = os.fsync

    def refused(descriptor: int) -> None:
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            raise OSError(number, os.strerror(number))
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", refused)
    atomic_write(tmp_path / "a", NEW)
    assert (tmp_path / "a").read_bytes() == NEW


def test_a_disk_that_fails_to_sync_a_folder_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "fsync", refuse(errno.EIO))
    with pytest.raises(OSError, match="Input/output error"):
        sync_folder(tmp_path)


def test_two_writers_do_not_mix(tmp_path: Path) -> None:
    path = tmp_path / "a"
    with atomic_file(path) as file:
        file.write(b"the first")
        file.flush()
        with pytest.raises(StorageError, match="Another process writes .*a; wait for its end, or choose another name"):
            atomic_write(path, NEW)
    assert [(entry.name, entry.read_bytes()) for entry in tmp_path.iterdir()] == [("a", b"the first")]


def test_who_opens_while_another_gives_the_name_does_not_write_into_the_finished_file(tmp_path: Path) -> None:
    """The one opens the file before the other has renamed it, and gets the lock after that."""
    path = tmp_path / "a"
    writers, rounds, wrong = 4, 200, list[bytes]()
    contents = [bytes([65 + number]) * 1000 for number in range(writers)]

    def write(content: bytes) -> None:
        for _ in range(rounds):
            try:
                atomic_write(path, content, sync=False)
            except StorageError:
                continue
            if (found := path.read_bytes()) not in contents:
                wrong.append(found)

    threads = [threading.Thread(target=write, args=(content,)) for content in contents]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong
    assert path.read_bytes() in contents
    assert [entry.name for entry in tmp_path.iterdir()] == ["a"]


def test_what_another_process_writes_is_not_removed(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(OLD)
    file = GrowingFile(path)
    file.append(NEW)
    with pytest.raises(StorageError, match="Another process writes"):
        remove_unused(path)
    assert (path.read_bytes(), partial_path(path).read_bytes()) == (OLD, NEW)
    file.close()
    remove_unused(path)
    remove_unused(path)
    assert not [*tmp_path.iterdir()]
    path.mkdir()
    with pytest.raises(StorageError, match="cannot be replaced .*; choose another name"):
        remove_unused(path)


def test_two_writers_of_a_growing_file_do_not_mix(tmp_path: Path) -> None:
    first = GrowingFile(tmp_path / "a")
    first.append(b"one")
    with pytest.raises(StorageError, match="Another process writes"):
        GrowingFile(tmp_path / "a")
    first.append(b"two")
    first.close()
    assert partial_path(tmp_path / "a").read_bytes() == b"onetwo"


def test_a_growing_file_that_has_become_shorter_is_not_continued(tmp_path: Path) -> None:
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


def test_the_folder_of_a_growing_file_is_created_or_reported(tmp_path: Path) -> None:
    GrowingFile(tmp_path / "new" / "folder" / "a").close()
    assert partial_path(tmp_path / "new" / "folder" / "a").exists()
    (tmp_path / "file").touch()
    with pytest.raises(StorageError, match="cannot be written"):
        GrowingFile(tmp_path / "file" / "a")


TRY = "import sys; from structgstream.atomic_files import lock_file\n"
TRY += "print(lock_file(open(sys.argv[1], 'w'), holder=sys.argv[2]))"


def another(path: Path, holder: str) -> bool:
    """Whether another process gets the lock."""
    command = [sys.executable, "-c", TRY, str(path), holder]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout == "True\n"


@pytest.mark.parametrize("holder", ["file", "process"])
def test_a_lock_keeps_others_out_until_its_file_is_closed(tmp_path: Path, holder: Literal["file", "process"]) -> None:
    """Others are all open files, or other processes."""
    path = tmp_path / "lock"
    with path.open("w") as first, path.open("w") as second:
        assert lock_file(first, holder=holder)
        assert lock_file(second, holder=holder) == (holder == "process")
        assert not another(path, holder)
    assert another(path, holder)


@pytest.mark.parametrize("holder", ["file", "process"])
def test_a_file_system_without_locks_gives_them_to_everyone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, holder: Literal["file", "process"]
) -> None:
    monkeypatch.setattr("fcntl.flock", refuse(errno.ENOLCK))
    monkeypatch.setattr("fcntl.lockf", refuse(errno.ENOLCK))
    with (tmp_path / "lock").open("w") as file:
        assert lock_file(file, holder=holder)


def test_what_is_in_a_lockable_file_stays_and_a_link_to_a_file_is_not_followed(tmp_path: Path) -> None:
    mine, link, dangling = tmp_path / "mine", tmp_path / "link", tmp_path / "dangling"
    mine.write_text("mine")
    link.symlink_to(mine)
    dangling.symlink_to(tmp_path / "missing")
    open_lockable(mine).close()
    for path in (link, dangling):
        with pytest.raises(OSError, match=f"{path.name} in it is a link, which is not followed"):
            open_lockable(path)
    assert mine.read_text() == "mine"
    assert not (tmp_path / "missing").exists()

# SPDX-License-Identifier: Apache-2.0
"""Locks keep others out, as long as their holder lives."""

import errno
import subprocess
import sys
from pathlib import Path

import pytest

from structgstream.atomic_files import lock_file, open_lockable

TRY = "import sys; from structgstream.atomic_files import lock_file\n"
TRY += "print(lock_file(open(sys.argv[1], 'w'), holder=sys.argv[2]))"


def another(path: Path, holder: str) -> bool:
    """Whether another process gets the lock."""
    command = [sys.executable, "-c", TRY, str(path), holder]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout == "True\n"


def test_an_open_file_keeps_everyone_out_until_it_is_closed(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    with path.open("w") as first, path.open("w") as second:
        assert lock_file(first)
        assert not lock_file(second)
        assert not another(path, "file")
    assert another(path, "file")


def test_a_process_keeps_other_processes_out_and_not_itself(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    with path.open("w") as first, path.open("w") as second:
        assert lock_file(first, holder="process")
        assert lock_file(second, holder="process")
        assert not another(path, "process")
    assert another(path, "process")


@pytest.mark.parametrize("holder", ["file", "process"])
def test_a_file_system_without_locks_gives_them_to_everyone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, holder: str
) -> None:
    def unknown(file: object, how: int) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr("fcntl.flock", unknown)
    monkeypatch.setattr("fcntl.lockf", unknown)
    with (tmp_path / "lock").open("w") as file:
        assert lock_file(file, holder="file" if holder == "file" else "process")


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

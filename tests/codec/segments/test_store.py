# SPDX-License-Identifier: Apache-2.0
"""A file of a store is the old one or the new one, whatever happens while it is written."""

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from structgstream.codec.segments.manifest import file_name
from structgstream.codec.segments.store import FolderStore, is_ours
from structgstream.errors import StorageError, StreamError


def test_files_are_written_replaced_listed_and_removed(tmp_path: Path) -> None:
    store = FolderStore(tmp_path / "new" / "folder")
    assert store.names() == frozenset()
    store.prepare()
    store.put("manifest.json", b"1")
    store.put("manifest.json", b"22")
    (store.folder / "notes.txt").write_text("mine")
    assert store.get("manifest.json") == b"22"
    assert store.names() == {"manifest.json"}
    store.delete("manifest.json")
    store.delete("manifest.json")
    assert sorted(os.listdir(store.folder)) == ["notes.txt"]
    with pytest.raises(StreamError, match=r"Cannot read .*manifest\.json \(No such file"):
        store.get("manifest.json")
    assert store.free_bytes() > 0


def test_a_failed_write_leaves_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = FolderStore(tmp_path)
    store.put("manifest.json", b"old")

    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(StorageError, match=r"Cannot write 3 bytes to .*manifest\.json \(No space left on device\)"):
        store.put("manifest.json", b"new")
    assert os.listdir(tmp_path) == ["manifest.json"]
    assert store.get("manifest.json") == b"old"


def test_what_a_killed_writer_left_is_removed_and_nothing_else(tmp_path: Path) -> None:
    (tmp_path / ".new-manifest.json").write_bytes(b"half")
    (tmp_path / ".new-structgstream-owner.json").write_bytes(b"half")
    others = [".new", ".new-notes.txt"]
    for name in others:
        (tmp_path / name).write_bytes(b"not ours")
    FolderStore(tmp_path).prepare()
    assert sorted(os.listdir(tmp_path)) == others


def test_a_file_in_the_place_of_the_folder(tmp_path: Path) -> None:
    (tmp_path / "stream").write_text("x")
    with pytest.raises(StorageError, match="stream cannot be made"):
        FolderStore(tmp_path / "stream").prepare()
    with pytest.raises(StreamError, match="Cannot list"):
        FolderStore(tmp_path / "stream").names()


def test_names_of_the_sink_are_those_of_the_document_and_known() -> None:
    sixteen, digest = "0123456789abcdef", "0123456789abcdef" + "0" * 48
    given = (("init", 0), ("part", 12), ("segment", 123456789), ("history", 0))
    ours = [file_name(kind, number, digest) for kind, number in given]
    assert ours[:2] == [f"init-0000-{sixteen}.sgs", f"part-00000012-{sixteen}.sgs"]
    assert ours[2:] == [f"segment-123456789-{sixteen}.sgs", f"history-00000000-{sixteen}.json"]
    assert all(map(is_ours, [*ours, "manifest.json"]))
    assert not any(map(is_ours, ["notes.txt", "part-1.sgs", f"x{ours[0]}", f"{ours[0]}x", f"{ours[0]}\n", ".new-x"]))


def test_one_process_writes_at_a_time(tmp_path: Path) -> None:
    """The lock ends with the process, however that ends."""
    store = FolderStore(tmp_path)
    child = (
        "import sys; from structgstream.codec.segments.store import FolderStore; store = FolderStore(sys.argv[1]);"
        "store.lock(); print('locked', flush=True); sys.stdin.read()"
    )
    command = [sys.executable, "-c", child, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stdin=subprocess.PIPE) as other:
        assert other.stdout.readline() == b"locked\n"
        with pytest.raises(StorageError, match="Another process writes to .*; wait for its end"):
            store.lock()
        other.kill()
    store.lock()
    FolderStore(tmp_path).lock()
    assert store.names() == frozenset()


def test_a_lock_that_is_a_link_leaves_the_file_that_it_points_to(tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("mine")
    (tmp_path / "stream").mkdir()
    (tmp_path / "stream" / ".writer").symlink_to(tmp_path / "mine")
    with pytest.raises(StorageError, match=".writer in it is a link, which is not followed"):
        FolderStore(tmp_path / "stream").lock()
    assert (tmp_path / "mine").read_text() == "mine"

# SPDX-License-Identifier: Apache-2.0
"""Objects are what was written, or none; what fails is tried again, and no longer than that."""

import re
from pathlib import Path
from typing import Any

import pytest

from structgstream.errors import StorageError
from structgstream.owned_folders import MARKER, Owner
from structgstream.parallel import exchange
from structgstream.parallel.exchange import TRIES, ObjectFolder


@pytest.fixture
def store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ObjectFolder:
    monkeypatch.setattr(exchange, "FIRST_DELAY_SECONDS", 0.0)
    return ObjectFolder(f"file://{tmp_path / 'store'}")


def test_what_is_written_is_read(store: ObjectFolder) -> None:
    for name, data in (("a", b""), ("deep/b", b"b" * 1000), ("deep/b", b"new")):
        store.write(name, data)
        assert (store.read(name), store.size(name)) == (data, len(data))


def test_what_is_not_there_is_none(store: ObjectFolder) -> None:
    assert store.read("a") is None
    assert store.size("a") is None
    assert store.owner() is None
    store.remove(re.compile(".*"))


def test_only_a_marked_folder_is_emptied_and_only_of_what_is_named(store: ObjectFolder, tmp_path: Path) -> None:
    owner = Owner.new("parts of a parallel run")
    store.write("deep/b", b"b")
    for action in (store.owner, lambda: store.remove(re.compile(".*"))):
        with pytest.raises(StorageError, match="may be somebody else's; nothing there was changed"):
            action()
    assert store.read("deep/b") == b"b"
    store.write(MARKER, owner.content)
    (tmp_path / "store" / "mine.txt").write_text("mine")
    assert store.owner() == owner
    store.remove(re.compile("deep/.*"))
    assert store.read("deep/b") is None
    assert (tmp_path / "store" / "mine.txt").read_text() == "mine"
    assert store.owner() == owner


@pytest.mark.parametrize("failures", [TRIES - 1, TRIES])
def test_failures_are_tried_again_so_often(store: ObjectFolder, monkeypatch: pytest.MonkeyPatch, failures: int) -> None:
    store.write("a", b"content")
    real, left = store._files.cat_file, [failures]

    def failing(*arguments: Any) -> bytes:
        left[0] -= 1
        if left[0] >= 0:
            raise ConnectionError("the cable is out")
        return real(*arguments)

    monkeypatch.setattr(store._files, "cat_file", failing)
    if failures < TRIES:
        assert store.read("a") == b"content"
    else:
        with pytest.raises(StorageError, match="the cable is out"):
            store.read("a")

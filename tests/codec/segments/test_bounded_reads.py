# SPDX-License-Identifier: Apache-2.0
"""Files of a folder are read within bounds, whatever lies there."""

import os
from pathlib import Path

import pytest

from structgstream.codec.segments.quality_list import QUALITIES, read_list
from structgstream.codec.segments.store import FolderStore
from structgstream.codec.segments.stored_bytes import read_manifest
from structgstream.errors import StorageError, StreamError
from structgstream.recorder import segments_folder


def make_endless(path: Path, kind: str) -> None:
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "folder":
        path.mkdir()
    else:
        with path.open("wb") as file:
            file.truncate(40 * 2**30)


@pytest.mark.parametrize("kind", ["pipe", "device", "sparse", "folder"])
def test_what_never_ends_is_refused_before_it_is_read(tmp_path: Path, kind: str) -> None:
    for name in ("manifest.json", QUALITIES, "segment-0000-0123456789abcdef.sgs"):
        make_endless(tmp_path / name, kind)
    store = FolderStore(tmp_path)
    expected = "expected at most|not a regular file|Is a directory"
    with pytest.raises(StreamError, match=expected):
        read_manifest(store)
    with pytest.raises(StreamError, match=expected):
        read_list(tmp_path)
    with pytest.raises(StreamError, match=expected):
        store.get("segment-0000-0123456789abcdef.sgs", max_bytes=1000)


def test_a_file_of_the_stated_size_is_read(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"abc")
    assert FolderStore(tmp_path).get("a", max_bytes=3) == FolderStore(tmp_path).get("a") == b"abc"
    with pytest.raises(StreamError, match="a has 3 bytes; expected at most 2"):
        FolderStore(tmp_path).get("a", max_bytes=2)


@pytest.mark.parametrize("content", [b'{"name": "my web application", "icons": []}', b"not JSON"])
def test_the_manifest_of_another_program_is_not_replaced(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "manifest.json").write_bytes(content)
    with pytest.raises(StorageError, match="has a manifest.json of another program"):
        segments_folder(tmp_path, may_exist=True)
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [("manifest.json", content)]

# SPDX-License-Identifier: Apache-2.0
"""A stream of segments as one stream file."""

import os
from pathlib import Path

import pytest

from structgstream.codec.segments.store import FolderStore
from structgstream.codec.segments.stored_bytes import read_manifest, write_archive
from structgstream.errors import StreamError
from tests.support.segment_folders import GrowingFolder
from tests.support.segment_streams import folder, packets, written
from tests.support.streams import flipped, small_stream

SENT = packets(7)


@pytest.fixture
def store(tmp_path: Path) -> FolderStore:
    found = folder(tmp_path / "out")
    written(found, SENT)
    return found


def test_a_run_that_has_not_ended_gives_a_file_without_an_index(tmp_path: Path) -> None:
    stream = small_stream(4)
    growing = GrowingFolder(tmp_path / "out", stream)
    for frames in (1, 2, 3):
        growing.write()
        assert write_archive(folder(tmp_path / "out"), tmp_path / "a.sgs") == frames
        assert stream.startswith((tmp_path / "a.sgs").read_bytes())


@pytest.mark.parametrize("which", ["init", "segment"])
def test_what_was_there_stays_when_a_file_is_damaged(store: FolderStore, tmp_path: Path, which: str) -> None:
    (tmp_path / "a.sgs").write_bytes(b"an earlier archive")
    manifest = read_manifest(store)
    name = manifest.periods[0].file if which == "init" else manifest.segments[-1].file
    data = store.get(name)
    store.put(name, flipped(data, len(data) // 2 * 8))
    with pytest.raises(StreamError, match=f"{name} in .* is damaged"):
        write_archive(store, tmp_path / "a.sgs")
    assert (tmp_path / "a.sgs").read_bytes() == b"an earlier archive"
    assert sorted(os.listdir(tmp_path)) == ["a.sgs", "out"]

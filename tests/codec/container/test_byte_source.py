# SPDX-License-Identifier: Apache-2.0
import gc
import os
from pathlib import Path

import pytest

from structgstream.codec.container.byte_source import ByteSlice, FileBytes
from structgstream.errors import StreamError

DATA = bytes(range(200))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "data"
    path.write_bytes(DATA)
    return path


@pytest.mark.parametrize("key", [slice(3, 9), slice(None, 4), slice(190, None), slice(150, 900), slice(9, 3), slice(0)])
def test_pieces_are_those_of_bytes(path: Path, key: slice) -> None:
    stored = FileBytes(path)
    assert stored[key] == DATA[key]
    part, inner = ByteSlice(stored, 20, 120), DATA[20:120]
    assert part[key] == inner[key]
    assert (len(stored), len(part), len(ByteSlice(stored, 150, 900)), len(ByteSlice(stored, 300, 900))) == (
        200,
        100,
        50,
        0,
    )


def test_what_is_appended_is_not_seen_and_what_is_cut_is_reported(path: Path) -> None:
    stored = FileBytes(path)
    with path.open("ab") as file:
        file.write(b"more")
    assert stored[190:] == DATA[190:]
    os.truncate(path, 195)
    assert stored[190:195] == DATA[190:195]
    for key in (slice(190, None), slice(197, None)):
        with pytest.raises(StreamError, match="has become shorter since it was opened"):
            stored[key]


def test_a_read_that_gives_less_at_a_time_is_repeated(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stored = FileBytes(path)
    pread = os.pread
    monkeypatch.setattr(os, "pread", lambda handle, count, start: pread(handle, min(count, 7), start))
    assert stored[10:150] == DATA[10:150]
    assert stored[10:900] == DATA[10:]


def test_a_closed_file_says_so(path: Path) -> None:
    stored = FileBytes(path)
    stored.close()
    stored.close()
    with pytest.raises(StreamError, match="has been closed; open it again"):
        stored[0:1]


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="the system does not list open files")
def test_a_reader_that_nobody_closes_leaves_no_open_file(path: Path) -> None:
    gc.collect()
    before = len(os.listdir("/proc/self/fd"))
    stored = FileBytes(path)
    assert len(os.listdir("/proc/self/fd")) == before + 1
    del stored  # and no ResourceWarning, which would fail this test
    gc.collect()
    assert len(os.listdir("/proc/self/fd")) == before

# SPDX-License-Identifier: Apache-2.0
"""A stream of segments as the bytes of a stream file."""

from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from structgstream.codec.container.records import PacketKind
from structgstream.codec.segments.manifest import MANIFEST, manifest_to_json
from structgstream.codec.segments.quality_list import ListedQuality, write_list
from structgstream.codec.segments.store import FolderStore
from structgstream.codec.segments.stored_bytes import StoredBytes, is_segments, open_segments
from structgstream.errors import StreamError
from tests.support.properties import examples
from tests.support.segment_folders import GrowingFolder
from tests.support.segment_streams import folder
from tests.support.streams import flipped, small_stream

STREAM = small_stream(7)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished folder of :data:`STREAM`."""
    path = tmp_path_factory.mktemp("whole") / "studio"
    GrowingFolder(path, STREAM).write_all()
    return path


@given(start=st.integers(-4000, 4000), stop=st.integers(-4000, 4000))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], parent=examples(300))
def test_any_slice_is_that_of_the_file(whole: Path, start: int, stop: int) -> None:
    with open_segments(whole) as stored:
        assert len(stored) == len(STREAM)
        assert stored[start:stop] == STREAM[start:stop]


def test_all_files_in_their_order(whole: Path) -> None:
    assert b"".join(open_segments(whole / MANIFEST).files()) == STREAM


def test_what_is_known_of_frames(whole: Path) -> None:
    stored = open_segments(whole)
    assert stored.kinds == [PacketKind.DELTA if i % 3 else PacketKind.KEY for i in range(7)]
    assert sum(stored.sizes) < len(STREAM)
    assert stored.gone == []


def test_a_file_that_is_held_needs_not_be_there(tmp_path: Path) -> None:
    growing = GrowingFolder(tmp_path, STREAM)
    manifest = growing.write()
    store = folder(tmp_path)
    part = manifest.parts[0]
    content = store.get(part.file)
    store.delete(part.file)
    with pytest.raises(StreamError, match=f"has no {part.file}, which its manifest names"):
        StoredBytes(store, manifest)
    stored = StoredBytes(store, manifest, held={part.file: content})
    assert stored[:] == STREAM[: len(stored)]
    assert stored.kinds == [PacketKind.KEY]


def test_a_segment_of_the_window_must_be_there(tmp_path: Path) -> None:
    growing = GrowingFolder(tmp_path, STREAM)
    manifest = growing.write_all()
    (tmp_path / manifest.segments[1].file).unlink()
    with pytest.raises(StreamError, match=f"has no {manifest.segments[1].file}"):
        open_segments(tmp_path)
    left = replace(manifest, window=replace(manifest.window, first_frame=6, first_segment=2))
    (tmp_path / MANIFEST).write_bytes(manifest_to_json(left))
    stored = open_segments(tmp_path)
    assert stored.gone == [range(3, 6)]
    assert (len(stored.sizes), len(stored.kinds)) == (7, 7)
    assert len(stored) < len(STREAM)


def test_a_damaged_file_is_seen_by_its_length_or_with_check_by_its_hash(tmp_path: Path) -> None:
    manifest = GrowingFolder(tmp_path, STREAM).write_all()
    store, name = FolderStore(tmp_path), manifest.segments[0].file
    data = store.get(name)
    store.put(name, flipped(data, 8 * len(data) - 8))
    assert len(StoredBytes(store, manifest)[:]) == len(STREAM)
    with pytest.raises(StreamError, match=f"{name} in .* is damaged"):
        StoredBytes(store, manifest, check=True)[:]
    store.put(name, data[:-1])
    with pytest.raises(StreamError, match=f"{name} in .* has {len(data) - 1} bytes; the manifest states {len(data)}"):
        StoredBytes(store, manifest)[:]


def test_few_files_are_kept_in_memory_and_none_after_closing(whole: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[str] = []
    get = FolderStore.get

    def counted(self: FolderStore, name: str, *, max_bytes: int | None = None) -> bytes:
        read.append(name)
        return get(self, name, max_bytes=max_bytes)

    stored = open_segments(whole)
    monkeypatch.setattr(FolderStore, "get", counted)
    for _ in range(3):
        assert stored[20:30] == STREAM[20:30]
    assert len(read) == 1
    assert stored[:] == STREAM
    assert len(read) == 4
    assert stored[20:30] == STREAM[20:30]
    assert len(read) == 5
    stored.close()
    assert stored[20:30] == STREAM[20:30]
    assert len(read) == 6


def test_what_is_a_stream_of_segments(tmp_path: Path) -> None:
    assert is_segments(tmp_path)
    assert is_segments(tmp_path / MANIFEST)
    assert not is_segments(tmp_path / "ball.sgs")
    with pytest.raises(StreamError, match=r"has no manifest.json; expected a folder written with --sink segments"):
        open_segments(tmp_path)
    write_list(tmp_path, [ListedQuality(name, f"{name}/manifest.json", 1e6) for name in ("low", "high")])
    with pytest.raises(StreamError, match=f"give the folder of one: {tmp_path}/low, {tmp_path}/high"):
        open_segments(tmp_path)
    (tmp_path / MANIFEST).write_text("{}")
    with pytest.raises(StreamError, match=f"manifest.json in {tmp_path} has no 'format'"):
        open_segments(tmp_path)

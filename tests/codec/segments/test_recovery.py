# SPDX-License-Identifier: Apache-2.0
"""Finds a stream that a writer left, stopped or killed (``test_sink`` kills one at each of its operations)."""

import os
from dataclasses import replace
from pathlib import Path

import pytest

from structgstream.codec.container.records import RecordType, packed
from structgstream.codec.segments.manifest import MANIFEST, Manifest, Window, manifest_to_json
from structgstream.codec.segments.recovery import find, part_of, stale_files
from structgstream.codec.segments.store import FolderStore
from structgstream.errors import StreamError
from tests.support.segment_folders import GrowingFolder
from tests.support.streams import flipped, small_stream

STREAM = small_stream(8)


class Left:
    """A folder as a writer leaves it after so many frames, and after a frame more that no manifest names."""

    def __init__(self, path: Path, frames: int, *, finished: bool = False, more: int = 0) -> None:
        growing = GrowingFolder(path, STREAM)
        for _ in range(frames):
            growing.write()
        if finished:
            growing.finish()
        self.store, self.manifest = FolderStore(path), growing.manifest
        for _ in range(more):
            growing.write()
        assert self.manifest is not None or not frames
        if self.manifest is None:
            (path / MANIFEST).unlink(missing_ok=True)
        else:
            self.store.put(MANIFEST, manifest_to_json(self.manifest))
        assert growing.manifest is not None or not (frames + more)
        self.last = growing.manifest

    def flip(self, name: str) -> None:
        data = self.store.get(name)
        self.store.put(name, flipped(data, 8 * (len(data) - 5)))

    def found(self) -> Manifest:
        draft = find(self.store)
        assert [len(record) for record in draft.records] == [part.bytes for part in draft.manifest.parts]
        return draft.manifest


@pytest.mark.parametrize("kind", [RecordType.INIT, RecordType.INDEX, RecordType.KEY])
def test_what_is_no_packet_is_no_part(kind: RecordType) -> None:
    data = packed(kind, bytes(11 if kind is RecordType.KEY else 13))
    for content in (data, packed(RecordType.KEY, bytes(12))[:-1], b""):
        with pytest.raises(StreamError, match=f"^{len(content)} bytes are no whole record of a packet"):
            part_of(content)


@pytest.mark.parametrize("frames", [1, 2, 3, 4, 7])
def test_what_the_manifest_names(tmp_path: Path, frames: int) -> None:
    left = Left(tmp_path, frames)
    assert left.found() == left.manifest


@pytest.mark.parametrize("frames", [0, 1, 2, 3, 5, 6])
def test_a_part_that_no_manifest_names_counts(tmp_path: Path, frames: int) -> None:
    left = Left(tmp_path, frames, more=1)
    before = set(os.listdir(tmp_path))
    found, last = left.found(), left.last
    assert (found.edge.frame, found.edge.pts_seconds) == (frames, last.edge.pts_seconds)
    assert [part.file for part in found.parts] == [part.file for part in last.parts]
    assert [one.file for one in found.segments] == [one.file for one in last.segments]
    assert set(os.listdir(tmp_path)) == before, "finding changes nothing"


def test_a_part_whose_content_is_not_its_name_was_never_written(tmp_path: Path) -> None:
    left = Left(tmp_path, 2, more=1)
    left.flip(left.last.parts[-1].file)
    assert left.found().edge.frame == 1


def test_a_frame_after_a_gap_does_not_count(tmp_path: Path) -> None:
    left = Left(tmp_path, 4, more=2)
    (tmp_path / left.last.parts[-2].file).unlink()
    assert left.found().edge.frame == 3


@pytest.mark.parametrize(("frames", "parts"), [(2, 1), (4, 0)])
def test_a_damaged_last_part_is_as_none(tmp_path: Path, frames: int, parts: int) -> None:
    left = Left(tmp_path, frames)
    left.flip(left.manifest.parts[-1].file)
    found = left.found()
    assert (found.edge.frame, len(found.parts)) == (frames - 2, parts)
    assert found.edge.pts_seconds == pytest.approx((frames - 2) / 30)
    assert found.edge.captured_unix_seconds is None


def test_a_damaged_only_frame_begins_again(tmp_path: Path) -> None:
    left = Left(tmp_path, 1)
    left.flip(left.manifest.parts[0].file)
    assert find(left.store) is None


def test_a_stopped_group_is_opened_again_by_the_next_frame(tmp_path: Path) -> None:
    left = Left(tmp_path, 5, finished=True)
    assert (left.found().parts, left.found().edge.frame) == ((), 4)
    straight = GrowingFolder(tmp_path / "other", STREAM)
    for _ in range(5):
        straight.write()
    last = straight.write()
    left.store.put(last.parts[-1].file, FolderStore(tmp_path / "other").get(last.parts[-1].file))
    found = left.found()
    assert [part.file for part in found.parts] == [part.file for part in last.parts]
    assert len(found.segments) == 1


@pytest.mark.parametrize("which", ["init", "segment"])
def test_a_missing_file_is_named(tmp_path: Path, which: str) -> None:
    left = Left(tmp_path, 5)
    name = left.manifest.periods[0].file if which == "init" else left.manifest.segments[0].file
    (tmp_path / name).unlink()
    with pytest.raises(StreamError, match=f"its manifest names {name}, which is missing. Put it back, or start again"):
        find(left.store)


def test_a_damaged_part_before_the_last_is_not_given_up(tmp_path: Path) -> None:
    left = Left(tmp_path, 3)
    left.flip(left.manifest.parts[1].file)
    with pytest.raises(StreamError, match="Continuing would lose the frames after it. Keep a copy"):
        find(left.store)


def test_frames_without_a_manifest_are_not_overwritten(tmp_path: Path) -> None:
    left = Left(tmp_path, 2)
    (tmp_path / MANIFEST).unlink()
    with pytest.raises(StreamError, match=r"it has frames of a stream, but no manifest\.json"):
        find(left.store)


def test_before_the_first_frame_there_is_nothing(tmp_path: Path) -> None:
    left = Left(tmp_path, 0)
    assert find(left.store) is None
    init = next(iter(left.store.names()))
    left.store.put(f"init-0000-{'0' * 16}.sgs", b"another")
    assert find(left.store) is None
    left.store.delete(f"init-0000-{'0' * 16}.sgs")
    left.flip(init)
    assert find(left.store) is None


def test_what_nobody_names_is_stale(tmp_path: Path) -> None:
    left = Left(tmp_path, 7)
    manifest = left.manifest
    odd = {"part-00000000-" + "0" * 16 + ".sgs", "segment-00000002-" + "0" * 16 + ".sgs", "notes.txt"}
    page = "history-00000000-" + "0" * 16 + ".json"
    there = left.store.names() | odd | {page}
    named = {MANIFEST, *(entry.file for entry in (*manifest.periods, *manifest.segments, *manifest.parts))}
    assert stale_files(manifest, frozenset(there)) == there - named - {page} >= odd
    windowed = replace(manifest, window=Window(6, 2, 1.0))
    # The first segment of the running period stays, the second is gone.
    assert stale_files(windowed, frozenset(there)) == (there - named - {page}) | {manifest.segments[1].file}


def test_segments_on_pages_stay_as_long_as_the_window_holds_them(tmp_path: Path) -> None:
    left = Left(tmp_path, 7)
    manifest = left.manifest
    names = [f"segment-{number:08d}-{'0' * 16}.sgs" for number in range(6)]
    listed = replace(manifest, segments=tuple(replace(one, segment=one.segment + 4) for one in manifest.segments))

    def stale(first: int) -> list[int]:
        windowed = replace(listed, window=Window(0, first, 1.0))
        found = stale_files(windowed, frozenset(names))
        return [number for number, name in enumerate(names) if name in found]

    assert stale(0) == [4, 5]
    assert stale(2) == [1, 4, 5]
    assert stale(4) == [1, 2, 3, 4, 5]

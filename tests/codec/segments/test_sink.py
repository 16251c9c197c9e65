# SPDX-License-Identifier: Apache-2.0
"""Segments are the bytes of the file sink in pieces, a reader of late finds everything, and a kill loses nothing."""

import os
from contextlib import suppress
from pathlib import Path

import pytest

from structgstream.codec.contents import LOST
from structgstream.codec.packets import PacketKind
from structgstream.codec.reader import StreamReader, open_stream
from structgstream.codec.segments.manifest import MANIFEST, Manifest
from structgstream.codec.segments.recovery import find
from structgstream.codec.segments.sink import SegmentsOptions, SegmentsSink
from structgstream.codec.segments.store import FolderStore
from structgstream.codec.segments.stored_bytes import StoredBytes, read_manifest, write_archive
from structgstream.codec.sinks import resume_segments
from structgstream.errors import StorageError, StreamError
from tests.support.segment_streams import Hands, Killed, KilledStore, as_file, folder, header, packets, written
from tests.support.streams import same

SENT = packets(8)


def archived(store: FolderStore) -> bytes:
    path = store.folder.parent / "archive.sgs"
    write_archive(store, path)
    return path.read_bytes()


def test_the_archive_is_the_file_that_the_file_sink_writes(tmp_path: Path) -> None:
    store = folder(tmp_path / "out")
    written(store, SENT)
    assert archived(store) == as_file(SENT)
    manifest = read_manifest(store)
    assert [(entry.first_frame, entry.frames) for entry in manifest.segments] == [(0, 3), (3, 3), (6, 2)]
    assert (manifest.live, manifest.parts, manifest.edge.frame) == (False, (), 7)
    assert (manifest.name, manifest.fps, manifest.sequence) == ("test", 30.0, 9)
    assert (manifest.frame_seconds, manifest.target_latency_seconds) == (1.0, 3.0)
    assert len(os.listdir(tmp_path)) == 2


def test_every_manifest_names_only_files_that_are_there_and_whole(tmp_path: Path) -> None:
    """Also the one before it and, for the time of grace, all others."""
    store = folder(tmp_path)
    seen: list[Manifest] = []
    whole = as_file(SENT)

    def look(frame: int) -> None:
        manifest = read_manifest(store)
        assert manifest.live
        assert (manifest.edge.frame, manifest.edge.published_unix_seconds) == (frame, 1.7e9 + frame + 1)
        assert [part.kind for part in manifest.parts] == [PacketKind.KEY, *[PacketKind.DELTA] * 2][: frame % 3 + 1]
        seen.append(manifest)
        for earlier in seen:
            stored = StoredBytes(store, earlier, check=True)
            assert whole.startswith(stored[: len(stored)])
        assert [one.sequence for one in seen] == [*range(1, frame + 2)]

    written(store, SENT, after=look)


def test_parts_stay_for_the_time_of_grace_and_then_go(tmp_path: Path) -> None:
    store, hands = folder(tmp_path), Hands()
    seen: list[list[int]] = []

    def look(frame: int) -> None:
        seen.append(sorted(int(name.split("-")[1]) for name in store.names() if name.startswith("part-")))

    written(store, SENT, options=SegmentsOptions(grace_seconds=2.5), hands=hands, after=look)
    # Frame 3 makes a segment of the first three; its parts are still there 2 seconds later, and not 3 seconds later.
    assert seen[3:] == [[0, 1, 2, 3], [0, 1, 2, 3, 4], [0, 1, 2, 3, 4, 5], [3, 4, 5, 6], [3, 4, 5, 6, 7]]


def test_a_folder_reads_as_the_file_does(tmp_path: Path) -> None:
    store = folder(tmp_path / "out")
    written(store, SENT)
    (tmp_path / "file.sgs").write_bytes(as_file(SENT))
    expected = open_stream(tmp_path / "file.sgs")
    for path in (store.folder, store.folder / MANIFEST):
        for by_index in (False, True):
            reader = open_stream(path, by_index=by_index)
            assert (reader.complete, reader.runs, len(reader)) == (True, [range(8)], 8)
            assert [*reader.packets] == [*expected.packets]
            assert reader.total_bytes == expected.total_bytes
            assert [p.payload for p in reader.group(5)] == [p.payload for p in SENT[5:6]]
            reader.close()


def test_a_stream_that_grows_is_read_up_to_its_edge(tmp_path: Path) -> None:
    store = folder(tmp_path)

    def look(frame: int) -> None:
        reader = open_stream(tmp_path)
        assert (len(reader), reader.complete) == (frame + 1, False)
        assert reader.cut_reason == f"it ends at byte {reader.total_bytes} without an index"

    written(store, SENT, after=look)


def test_killed_at_any_operation_it_goes_on_to_the_same_bytes(tmp_path: Path) -> None:
    """Before each, which is after the one before it, and after the last, once and again; what was reported is there."""
    whole = as_file(SENT)
    counter = KilledStore(folder(tmp_path / "count"), at=10**9, done=True)
    options = SegmentsOptions(grace_seconds=1.5)
    written(counter, SENT, options=options)
    assert any("delete part" in operation for operation in counter.operations)
    last = len(counter.operations) - 1
    for at, done in (*((at, False) for at in range(last + 1)), (last, True)):
        store = folder(tmp_path / f"{at}-{done}")
        reported: list[int] = []
        for place in (at, at // 2 + 1):
            with suppress(Killed):  # The second run may end before its place.
                written(KilledStore(store, place, done), SENT, options=options, after=reported.append)
            store.prepare()
            found = find(store)
            edge = -1 if found is None else found.manifest.edge.frame
            assert edge >= max(reported, default=-1)
        written(store, SENT, options=options)
        assert archived(store) == whole, (at, done)
        assert not [name for name in os.listdir(store.folder) if name.startswith(".")]


@pytest.mark.parametrize("more", [0, 1, 5])
def test_what_a_killed_run_wrote_too_early_stays_when_it_comes_again(tmp_path: Path, more: int) -> None:
    """Killed while closing: the short segment is there and no manifest names it, so that it counts as stale."""
    store, options, hands = folder(tmp_path / "out"), SegmentsOptions(grace_seconds=3.0), Hands()
    counter = KilledStore(folder(tmp_path / "count"), at=10**9, done=True)
    written(counter, SENT[:2], options=options)
    assert counter.operations[-2].startswith("put segment-00000000")
    with pytest.raises(Killed):
        written(KilledStore(store, len(counter.operations) - 2, True), SENT[:2], options=options)
    sink, resumed = resume_segments(store, options=options, clocks=hands.clocks())
    sink.open(resumed.header)
    for packet in SENT[2 : 2 + more]:
        hands.wait(1.0)
        sink.write(packet)
    hands.wait(10.0)
    sink.close()
    written(store, SENT, options=options, hands=hands)
    assert archived(store) == as_file(SENT)


def test_an_orderly_stop_in_the_middle_of_a_group_goes_on_to_the_same_segments(tmp_path: Path) -> None:
    whole = folder(tmp_path / "whole")
    written(whole, SENT)
    files = {entry.file for entry in read_manifest(whole).segments}
    for stop in range(1, 9):
        store = folder(tmp_path / f"{stop}")
        options = SegmentsOptions(grace_seconds=0.5)
        written(store, SENT[:stop], options=options)
        assert (read_manifest(store).live, archived(store)) == (False, as_file(SENT[:stop]))
        written(store, SENT, options=options)
        assert archived(store) == as_file(SENT)
        assert {entry.file for entry in read_manifest(store).segments} == files


def test_an_existing_stream_stays_unless_it_may_be_replaced(tmp_path: Path) -> None:
    store = folder(tmp_path / "out")
    written(store, SENT)
    (store.folder / "notes.txt").write_text("mine")
    with pytest.raises(StorageError, match="holds a stream; continue it with --resume, replace it with --overwrite"):
        SegmentsSink(store).open(header())
    assert archived(store) == as_file(SENT)
    sink = SegmentsSink(store, overwrite=True)
    sink.open(header())
    assert sorted(name[:5] for name in os.listdir(store.folder)) == ["init-", "notes"]
    sink.write(SENT[0])
    assert read_manifest(store).sequence == 10  # Whoever waits for a newer manifest gets one.
    sink.close()
    sink.close()
    assert archived(store) == as_file(SENT[:1])


def test_nothing_begun_is_nothing_left_to_read(tmp_path: Path) -> None:
    sink = SegmentsSink(folder(tmp_path))
    sink.close()
    sink.open(header())
    sink.close()
    assert resume_segments(folder(tmp_path))[1] is None
    written(folder(tmp_path), SENT)
    assert len(open_stream(tmp_path)) == 8


def test_the_window_and_what_has_left_it(tmp_path: Path) -> None:
    sent = packets(30)
    store = folder(tmp_path / "out")
    written(store, sent, options=SegmentsOptions(window_seconds=0.25, grace_seconds=4.5))
    manifest = read_manifest(store)
    # The edge is frame 29; a quarter of a second is 7.5 frames: frames 21 and later, so segments 7 to 9.
    assert (manifest.window.first_segment, manifest.window.first_frame, manifest.window.seconds) == (7, 21, 0.25)
    numbers = sorted(int(name.split("-")[1]) for name in store.names() if name.startswith("segment-"))
    assert numbers == [0, *range(5, 10)]  # 0 is needed to resume, 5 and 6 left less than 4.5 s ago
    reader = open_stream(store.folder)
    assert (reader.runs, reader.complete, len(reader)) == ([range(3), range(15, 30)], True, 3)
    assert reader.scene(29) is not None
    with pytest.raises(StreamError, match=r"Frame 5 of .* has left the window"):
        reader.scene(5)
    with pytest.raises(StreamError, match="frames 3 to 14 have left its window"):
        archived(store)


def test_a_group_that_is_opened_again_stays_in_a_window_shorter_than_a_frame(tmp_path: Path) -> None:
    """Its segment was closed early, and its end has left the window; its frames are parts again."""
    store, options, hands = folder(tmp_path), SegmentsOptions(window_seconds=0.01, grace_seconds=0.0), Hands()
    written(store, SENT[:5], options=options, hands=hands)
    windows = []
    written(store, SENT, options=options, hands=hands, after=lambda _: windows.append(read_manifest(store).window))
    assert [(one.first_segment, one.first_frame) for one in windows] == [(1, 3), (2, 6), (2, 6)]


def test_a_stream_with_a_window_is_continued_with_all_its_sizes(tmp_path: Path) -> None:
    sent = packets(180)
    whole, stopped = folder(tmp_path / "whole"), folder(tmp_path / "stopped")
    options = SegmentsOptions(window_seconds=1.0, grace_seconds=5.0)
    written(whole, sent, options=options)
    hands = Hands()
    written(stopped, sent[:130], options=options, hands=hands)
    _, resumed = resume_segments(stopped)
    records = [len(packet.payload) + 12 for packet in sent[:130]]
    assert [info.bytes for info in resumed.packets] == records
    assert [info.kind for info in resumed.packets] == [packet.kind for packet in sent[:130]]
    assert [packet.index for packet in resumed.group(129)] == [129]  # Codec raw; the sizes give the rest.
    assert resumed.scene(0) is not None
    written(stopped, sent, options=options, hands=hands)
    one, other = read_manifest(whole), read_manifest(stopped)
    assert (one.segments, one.history, one.window) == (other.segments, other.history, other.window)
    assert {name for name in whole.names() if "part" not in name} == {
        name for name in stopped.names() if "part" not in name
    }


def test_pages_are_read_where_segments_have_left_the_manifest(tmp_path: Path) -> None:
    sent = packets(50, group=1)
    store = folder(tmp_path / "out")
    written(store, sent)
    manifest = read_manifest(store)
    assert [(page.level, page.segments) for page in manifest.history] == [(0, 32)]
    assert [entry.segment for entry in manifest.segments] == [*range(32, 50)]
    assert archived(store) == as_file(sent)
    assert len(open_stream(store.folder)) == 50


def test_a_disk_that_is_nearly_full_closes_the_stream(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = folder(tmp_path / "out")
    sink = SegmentsSink(store)
    sink.open(header())
    sink.write(SENT[0])
    monkeypatch.setattr(FolderStore, "free_bytes", lambda self: 30_000)
    with pytest.raises(StorageError, match="nearly full: 30000 bytes are left.* closed after 1 frames"):
        sink.write(SENT[1])
    sink.close()
    assert archived(store) == as_file(SENT[:1])
    monkeypatch.undo()
    written(store, SENT)
    assert archived(store) == as_file(SENT)


def test_a_stream_that_cannot_be_closed_reports_its_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(store: FolderStore, name: str, data: bytes) -> None:
        raise StorageError("No space left.")

    sink = SegmentsSink(folder(tmp_path / "out"))
    sink.open(header())
    sink.write(SENT[0])
    monkeypatch.setattr(FolderStore, "put", full)
    with pytest.raises(StorageError, match="The 1 frames before are safe"):
        sink.close()
    sink.close()


def test_of_frames_that_have_left_the_window_size_kind_and_time_are_known(tmp_path: Path) -> None:
    sent, store = packets(9), folder(tmp_path)
    written(store, sent, options=SegmentsOptions(window_seconds=0.01, grace_seconds=0.0))
    found = resume_segments(store)[1]
    with StreamReader(as_file(sent)) as whole:
        gone = [info for info in found.packets if info.offset == LOST]
        assert [info.index for info in gone] == [3, 4, 5]
        assert [info.kind for info in gone] == [PacketKind.KEY, PacketKind.DELTA, PacketKind.DELTA]
        assert [info.bytes for info in found.packets] == [info.bytes for info in whole.packets]
        seconds = [info.pts_seconds for info in whole.packets]
        assert [info.pts_seconds for info in found.packets] == pytest.approx(seconds), "rate control needs all times"
        assert same(found.scene(8), whole.scene(8))

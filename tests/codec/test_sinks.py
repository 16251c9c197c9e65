# SPDX-License-Identifier: Apache-2.0
import errno
import io
import struct
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from structgstream.codec.container import byte_source
from structgstream.codec.container.records import RecordType, scan_records
from structgstream.codec.packets import Packet, PacketKind
from structgstream.codec.reader import open_stream
from structgstream.codec.scene_coder import SceneEncoder
from structgstream.codec.sinks import FileSink, MemorySink
from structgstream.errors import StorageError, StreamError
from tests.support.killed import folders_of_the_killed
from tests.support.streams import header_for, moved, same, small_scene, small_stream, write_stream

SCENES = [moved(small_scene(), i) for i in range(4)]


def packets() -> list[Packet]:
    encoder = SceneEncoder(header_for(SCENES[0]))
    kinds = [PacketKind.KEY, PacketKind.DELTA, PacketKind.DELTA, PacketKind.KEY]
    return [
        encoder.encode(scene, index=i, pts_seconds=i / 30.0, kind=kinds[i]).packet for i, scene in enumerate(SCENES)
    ]


class FullDisk(io.FileIO):
    """A file on a disk that has ``room`` bytes, of which a write takes what it can, as the kernel does."""

    room = 0
    interrupt = False

    def write(self, data: Any, /) -> int:
        taken = super().write(memoryview(data)[: max(self.room - self.tell(), 0)])
        if taken == 0:
            if self.interrupt:
                raise KeyboardInterrupt
            raise OSError(errno.ENOSPC, "No space left on device")
        return taken


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> type[FullDisk]:
    """Files opened by path are on a :class:`FullDisk`."""
    monkeypatch.setattr(FullDisk, "room", 10**9)
    monkeypatch.setattr(FullDisk, "interrupt", False)
    monkeypatch.setattr(Path, "open", lambda path, mode, buffering=-1: FullDisk(path, mode))
    return FullDisk


def test_both_sinks_give_the_same_bytes(tmp_path: Path) -> None:
    memory, file = MemorySink(), FileSink(tmp_path / "a.sgs")
    for one in (memory, file):
        promised = write_stream(one, SCENES)
    assert file.path.read_bytes() == memory.data
    reader = open_stream(file.path)
    assert all(same(scene, promised[info.index]) for info, scene in reader.scenes())


def test_writes_return_their_bytes_and_index_and_footer_point_at_them() -> None:
    sink = MemorySink()
    sizes = [sink.open(header_for(SCENES[0])), *(sink.write(packet) for packet in packets())]
    assert len(sink.data) == sum(sizes)
    sink.close()
    sink.close()
    offset, magic = struct.unpack("<Q8s", sink.data[-16:])
    assert (offset, magic) == (sum(sizes), b"SGSINDEX")
    index = list(scan_records(sink.data))[-1]
    assert (index.type, index.offset, index.end) == (RecordType.INDEX, offset, len(sink.data) - 16)
    entries = list(struct.iter_unpack("<IBQ", index.payload))
    assert entries == [(i, kind, sum(sizes[: i + 1])) for i, kind in enumerate((2, 3, 3, 2))]


def test_killed_at_any_step_a_file_goes_on_to_the_same_bytes(tmp_path: Path) -> None:
    """Also when the run that goes on is killed: while it cuts off what is not whole, or the index."""
    header, sent, whole = header_for(SCENES[0]), packets(), small_stream()

    def go_on(folder: Path) -> None:
        sink, found = FileSink.resume(folder / "a.sgs")
        sink.open(header)
        for packet in sent[0 if found is None else len(found) :]:
            sink.write(packet)
        sink.close()

    first = folders_of_the_killed(tmp_path, go_on, begin=lambda folder: None)
    lengths = sorted({path.stat().st_size for folder in first for path in folder.iterdir()})
    assert len(lengths) == len(sent) + 3, "empty, header, each packet, index"
    for left in (lengths[-1], lengths[-2] - 1):  # with the index, with a packet that is cut
        (tmp_path / str(left)).mkdir()

        def begin(folder: Path, left: int = left) -> None:
            (folder / "a.sgs").write_bytes(whole[:left])

        for folder in folders_of_the_killed(tmp_path / str(left), go_on, begin=begin):
            go_on(folder)
            assert (folder / "a.sgs").read_bytes() == whole


def test_the_whole_file_is_there_after_each_write(tmp_path: Path) -> None:
    sink = FileSink(tmp_path / "a.sgs")
    sink.open(header_for(SCENES[0]))
    for i, packet in enumerate(packets()):
        sink.write(packet)
        reader = open_stream(sink.path)
        assert (len(reader), reader.complete) == (i + 1, False)
    sink.close()


def test_an_existing_file_stays_unless_it_may_be_replaced(tmp_path: Path) -> None:
    path = tmp_path / "a.sgs"
    path.write_text("precious")
    with pytest.raises(StorageError, match="exists; continue it with --resume, replace it with --overwrite"):
        FileSink(path).open(header_for(SCENES[0]))
    assert path.read_text() == "precious"
    write_stream(FileSink(path, overwrite=True), SCENES)
    assert path.read_bytes() == small_stream()


@pytest.mark.parametrize("resumed", [False, True])
def test_a_file_that_is_being_written_is_not_opened_by_another(tmp_path: Path, resumed: bool) -> None:
    """Whichever process it is in; the lock belongs to the open file."""
    path, sent = tmp_path / "a.sgs", packets()
    first = FileSink(path)
    first.open(header_for(SCENES[0]))
    first.write(sent[0])
    second = FileSink.resume(path)[0] if resumed else FileSink(path, overwrite=True)
    for refused in (second.check_unused, lambda: second.open(header_for(SCENES[0]))):
        with pytest.raises(StorageError, match="Another process writes to .*a.sgs; wait for its end"):
            refused()
    second.close()
    for packet in sent[1:]:
        first.write(packet)
    first.close()
    second.check_unused()
    assert path.read_bytes() == small_stream()
    if resumed:
        with pytest.raises(StorageError, match="has been written to by another process since it was read"):
            second.open(header_for(SCENES[0]))
        assert path.read_bytes() == small_stream()


def test_a_place_where_nothing_can_be_written(tmp_path: Path) -> None:
    for path, overwrite in ((tmp_path / "no" / "a.sgs", False), (tmp_path, True)):
        sink = FileSink(path, overwrite=overwrite)
        with pytest.raises(StorageError, match="Cannot open .* for writing"):
            sink.open(header_for(SCENES[0]))
        sink.close()


def test_a_disk_that_fills_up_leaves_whole_frames(tmp_path: Path, disk: type[FullDisk]) -> None:
    """In the header, all over a packet record and what closes the file; resumed, it equals an uninterrupted run."""
    whole = small_stream()
    records = list(scan_records(whole))
    path = tmp_path / "a.sgs"
    packet, closing = range(records[2].offset, records[2].end, 61), range(records[5].offset, len(whole), 13)
    for room in [0, 5, records[0].end - 1, *packet, *closing]:
        disk.room = room
        sink = FileSink(path, overwrite=True)
        with pytest.raises(StorageError, match="No space left on device.*continue with --resume"):
            write_stream(sink, SCENES)
        sink.close()
        ends = [record.end for record in records[:5] if record.end <= room]
        assert path.stat().st_size == max(ends, default=0)
        disk.room = 10**9
        sink, reader = FileSink.resume(path)
        assert (0 if reader is None else len(reader)) == max(len(ends) - 1, 0)
        sink.open(header_for(SCENES[0]))
        for packet in packets()[0 if reader is None else len(reader) :]:
            sink.write(packet)
        sink.close()
        assert path.read_bytes() == whole


def test_a_failed_write_is_followed_by_no_index(tmp_path: Path, disk: type[FullDisk]) -> None:
    """A small index may fit where a packet did not; the file still says that it was not finished."""
    sink = FileSink(tmp_path / "a.sgs")
    sink.open(header_for(SCENES[0]))
    sink.write(packets()[0])
    disk.room = sink.path.stat().st_size + 200
    with pytest.raises(StorageError, match=r"The 1 frames before"):
        sink.write(packets()[1])
    sink.close()
    reader = open_stream(sink.path)
    assert (len(reader), reader.complete) == (1, False)
    assert reader.cut_reason == f"it ends at byte {sink.path.stat().st_size} without an index"


def test_an_interrupted_write_is_replaced_by_the_index(tmp_path: Path, disk: type[FullDisk]) -> None:
    sink = FileSink(tmp_path / "a.sgs")
    sink.open(header_for(SCENES[0]))
    sink.write(packets()[0])
    disk.room, disk.interrupt = sink.path.stat().st_size + 300, True
    with pytest.raises(KeyboardInterrupt):
        sink.write(packets()[1])
    disk.room = 10**9
    sink.close()
    expected = MemorySink()
    write_stream(expected, SCENES[:1])
    assert sink.path.read_bytes() == expected.data


def test_a_disk_that_is_nearly_full_is_reported_and_the_stream_gets_its_index(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three packets and the header are kept free."""
    free = {"bytes": 10**9}
    monkeypatch.setattr(byte_source.shutil, "disk_usage", lambda path: SimpleNamespace(free=free["bytes"]))
    sink = FileSink(tmp_path / "a.sgs")
    header_bytes = sink.open(header_for(SCENES[0]))
    size = sink.write(packets()[0])
    free["bytes"] = header_bytes + 3 * size
    with pytest.raises(StorageError, match=rf"nearly full: {free['bytes']} bytes are left.* closed after 1 frames"):
        sink.write(packets()[1])
    sink.close()
    expected = MemorySink()
    write_stream(expected, SCENES[:1])
    assert sink.path.read_bytes() == expected.data
    free["bytes"] = 10**9
    again, reader = FileSink.resume(sink.path)
    assert reader is not None
    again.open(reader.header)
    for packet in packets()[1:]:
        again.write(packet)
    again.close()
    assert sink.path.read_bytes() == small_stream()


def test_a_file_cut_anywhere_is_continued(tmp_path: Path) -> None:
    whole = small_stream()
    path = tmp_path / "a.sgs"
    ends = [record.end for record in scan_records(whole)][:5]
    for cut in sorted({0, *ends, *(end - 1 for end in ends), *range(5, len(whole), 211), len(whole)}):
        path.write_bytes(whole[:cut])
        sink, reader = FileSink.resume(path)
        done = 0 if reader is None else len(reader)
        assert done == max(sum(end <= cut for end in ends) - 1, 0)
        assert path.read_bytes() == whole[:cut]  # Nothing is touched before open().
        sink.open(header_for(SCENES[0]) if reader is None else reader.header)
        for packet in packets()[done:]:
            sink.write(packet)
        sink.close()
        assert path.read_bytes() == whole


def test_what_cannot_be_resumed(tmp_path: Path) -> None:
    damaged = bytearray(small_stream())
    damaged[40] ^= 1
    newer = bytearray(small_stream())
    newer[8] = 3
    for content, message in [
        (b"Dear", "is not a structgstream file"),
        (b"A long letter to someone.", "is not a structgstream file"),
        (
            bytes(damaged),
            "Cannot continue .*a.sgs: the record at byte 12 .* damaged. Keep a copy; then start again",
        ),
        (bytes(newer), "format version 3.0"),
    ]:
        path = tmp_path / "a.sgs"
        path.write_bytes(content)
        with pytest.raises(StreamError, match=message):
            FileSink.resume(path)
        assert path.read_bytes() == content
    with pytest.raises(StreamError, match="Cannot read"):
        FileSink.resume(tmp_path)

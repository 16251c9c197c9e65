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
from structgstream.codec.reader import open_stream
from structgstream.codec.sinks import FileSink, MemorySink
from structgstream.errors import StorageError, StreamError
from tests.support.killed import folders_of_the_killed
from tests.support.segment_streams import as_file, header, packets
from tests.support.streams import flipped, moved, same, small_scene, write_stream

SCENES = [moved(small_scene(), i) for i in range(4)]
SENT = packets(4)
HEADER = header()
WHOLE = as_file(SENT)


def go_on(path: Path) -> int:
    """Write what is missing of the stream in a file; how many frames it had."""
    sink, reader = FileSink.resume(path)
    done = 0 if reader is None else len(reader)
    sink.open(HEADER if reader is None else reader.header)
    for packet in SENT[done:]:
        sink.write(packet)
    sink.close()
    return done


def begun(path: Path) -> FileSink:
    """A sink after the first frame."""
    sink = FileSink(path)
    sink.open(HEADER)
    sink.write(SENT[0])
    return sink


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
    sizes = [sink.open(HEADER), *(sink.write(packet) for packet in SENT)]
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
    first = folders_of_the_killed(tmp_path, lambda folder: go_on(folder / "a.sgs"), begin=lambda folder: None)
    lengths = sorted({path.stat().st_size for folder in first for path in folder.iterdir()})
    assert len(lengths) == len(SENT) + 3, "empty, header, each packet, index"
    for left in (lengths[-1], lengths[-2] - 1):  # with the index, with a packet that is cut
        (tmp_path / str(left)).mkdir()

        def begin(folder: Path, left: int = left) -> None:
            (folder / "a.sgs").write_bytes(WHOLE[:left])

        for folder in folders_of_the_killed(tmp_path / str(left), lambda folder: go_on(folder / "a.sgs"), begin=begin):
            go_on(folder / "a.sgs")
            assert (folder / "a.sgs").read_bytes() == WHOLE


def test_the_whole_file_is_there_after_each_write(tmp_path: Path) -> None:
    sink = FileSink(tmp_path / "a.sgs")
    sink.open(HEADER)
    for i, packet in enumerate(SENT):
        sink.write(packet)
        reader = open_stream(sink.path)
        assert (len(reader), reader.complete) == (i + 1, False)
    sink.close()


def test_an_existing_file_stays_unless_it_may_be_replaced(tmp_path: Path) -> None:
    path = tmp_path / "a.sgs"
    path.write_text("precious")
    with pytest.raises(StorageError, match="exists; continue it with --resume, replace it with --overwrite"):
        FileSink(path).open(HEADER)
    assert path.read_text() == "precious"
    write_stream(FileSink(path, overwrite=True), SCENES)
    assert path.read_bytes() == WHOLE


@pytest.mark.parametrize("resumed", [False, True])
def test_a_file_that_is_being_written_is_not_opened_by_another(tmp_path: Path, resumed: bool) -> None:
    """Whichever process it is in; the lock belongs to the open file."""
    path = tmp_path / "a.sgs"
    first = begun(path)
    second = FileSink.resume(path)[0] if resumed else FileSink(path, overwrite=True)
    for refused in (second.check_unused, lambda: second.open(HEADER)):
        with pytest.raises(StorageError, match="Another process writes to .*a.sgs; wait for its end"):
            refused()
    second.close()
    for packet in SENT[1:]:
        first.write(packet)
    first.close()
    second.check_unused()
    assert path.read_bytes() == WHOLE
    if resumed:
        with pytest.raises(StorageError, match="has been written to by another process since it was read"):
            second.open(HEADER)
        assert path.read_bytes() == WHOLE


def test_a_place_where_nothing_can_be_written(tmp_path: Path) -> None:
    for path, overwrite in ((tmp_path / "no" / "a.sgs", False), (tmp_path, True)):
        sink = FileSink(path, overwrite=overwrite)
        with pytest.raises(StorageError, match="Cannot open .* for writing"):
            sink.open(HEADER)
        sink.close()


def test_a_disk_that_fills_up_leaves_whole_frames(tmp_path: Path, disk: type[FullDisk]) -> None:
    """In the header, all over a packet record and what closes the file; resumed, it equals an uninterrupted run."""
    records = list(scan_records(WHOLE))
    path = tmp_path / "a.sgs"
    packet, closing = range(records[2].offset, records[2].end, 61), range(records[5].offset, len(WHOLE), 13)
    for room in [0, 5, records[0].end - 1, *packet, *closing]:
        disk.room = room
        sink = FileSink(path, overwrite=True)
        with pytest.raises(StorageError, match="No space left on device.*continue with --resume"):
            write_stream(sink, SCENES)
        sink.close()
        ends = [record.end for record in records[:5] if record.end <= room]
        assert path.stat().st_size == max(ends, default=0)
        disk.room = 10**9
        assert go_on(path) == max(len(ends) - 1, 0)
        assert path.read_bytes() == WHOLE


def test_a_failed_write_is_followed_by_no_index(tmp_path: Path, disk: type[FullDisk]) -> None:
    """A small index may fit where a packet did not; the file still says that it was not finished."""
    sink = begun(tmp_path / "a.sgs")
    disk.room = sink.path.stat().st_size + 200
    with pytest.raises(StorageError, match=r"The 1 frames before"):
        sink.write(SENT[1])
    sink.close()
    reader = open_stream(sink.path)
    assert (len(reader), reader.complete) == (1, False)
    assert reader.cut_reason == f"it ends at byte {sink.path.stat().st_size} without an index"


def test_an_interrupted_write_is_replaced_by_the_index(tmp_path: Path, disk: type[FullDisk]) -> None:
    sink = begun(tmp_path / "a.sgs")
    disk.room, disk.interrupt = sink.path.stat().st_size + 300, True
    with pytest.raises(KeyboardInterrupt):
        sink.write(SENT[1])
    disk.room = 10**9
    sink.close()
    assert sink.path.read_bytes() == as_file(SENT[:1])


def test_a_disk_that_is_nearly_full_is_reported_and_the_stream_gets_its_index(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three packets and the header are kept free."""
    free = {"bytes": 10**9}
    monkeypatch.setattr(byte_source.shutil, "disk_usage", lambda path: SimpleNamespace(free=free["bytes"]))
    sink = FileSink(tmp_path / "a.sgs")
    header_bytes = sink.open(HEADER)
    size = sink.write(SENT[0])
    free["bytes"] = header_bytes + 3 * size
    with pytest.raises(StorageError, match=rf"nearly full: {free['bytes']} bytes are left.* closed after 1 frames"):
        sink.write(SENT[1])
    sink.close()
    assert sink.path.read_bytes() == as_file(SENT[:1])
    free["bytes"] = 10**9
    assert go_on(sink.path) == 1
    assert sink.path.read_bytes() == WHOLE


def test_a_file_cut_anywhere_is_continued(tmp_path: Path) -> None:
    path = tmp_path / "a.sgs"
    ends = [record.end for record in scan_records(WHOLE)][:5]
    for cut in sorted({0, *ends, *(end - 1 for end in ends), *range(5, len(WHOLE), 211), len(WHOLE)}):
        path.write_bytes(WHOLE[:cut])
        FileSink.resume(path)
        assert path.read_bytes() == WHOLE[:cut]  # Nothing is touched before open().
        assert go_on(path) == max(sum(end <= cut for end in ends) - 1, 0)
        assert path.read_bytes() == WHOLE


def test_what_cannot_be_resumed(tmp_path: Path) -> None:
    damaged = "Cannot continue .*a.sgs: the record at byte 12 .* damaged. Keep a copy; then start again"
    for content, message in [
        (b"Dear", "is not a structgstream file"),
        (b"A long letter to someone.", "is not a structgstream file"),
        (flipped(WHOLE, 8 * 40), damaged),
        (flipped(WHOLE, 8 * 8), "format version 3.0"),
    ]:
        path = tmp_path / "a.sgs"
        path.write_bytes(content)
        with pytest.raises(StreamError, match=message):
            FileSink.resume(path)
        assert path.read_bytes() == content
    with pytest.raises(StreamError, match="Cannot read"):
        FileSink.resume(tmp_path)

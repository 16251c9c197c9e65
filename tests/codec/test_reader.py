# SPDX-License-Identifier: Apache-2.0
"""A decoded scene serves every camera until another frame or another back-end is asked for."""

import os
import struct
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from structgstream.codec.container.records import PREFIX, RecordType, packed, prefix, scan_records
from structgstream.codec.packets import PacketKind, pack_header
from structgstream.codec.reader import StreamReader, open_stream
from structgstream.codec.scene_coder import SceneEncoder
from structgstream.codec.sinks import MemorySink
from structgstream.errors import StreamError
from structgstream.kernels.backend import Backend, reference_backend
from structgstream.scene.render import render, to_8bit_image
from structgstream.scene.scene import Scene
from tests.support.properties import THOROUGH
from tests.support.streams import header_for, moved, same, small_scene, small_stream, write_stream


def packet_record(index: int, kind: PacketKind, *, pts_seconds: float | None = None) -> bytes:
    pts = index / 30 if pts_seconds is None else pts_seconds
    scene = small_scene()
    encoded = SceneEncoder(header_for(scene)).encode(scene, index=index, pts_seconds=0.0, kind=kind)
    payload = struct.pack("<Id", index, pts) + encoded.packet.payload[12:]
    return packed(RecordType.KEY if kind is PacketKind.KEY else RecordType.DELTA, payload)


def with_records(*records: bytes) -> bytes:
    return prefix() + packed(RecordType.INIT, pack_header(header_for(small_scene()))) + b"".join(records)


def test_a_reader_sees_what_the_encoder_promised() -> None:
    sink = MemorySink()
    promised = write_stream(sink, [moved(small_scene(), i) for i in range(4)])
    reader = StreamReader(sink.data)
    assert reader.complete
    assert reader.cut_reason is None
    assert [info.kind for info in reader.packets] == [1, 2, 2, 1]
    assert [info.pts_seconds for info in reader.packets] == [0.0, 1 / 30, 2 / 30, 3 / 30]
    assert all(same(scene, promised[info.index]) for info, scene in reader.scenes())
    assert [info.index for info, _ in reader.scenes(2)] == [2, 3]


def test_bytes_are_all_accounted_for() -> None:
    data = small_stream()
    reader = StreamReader(data)
    index = 8 + 4 * 13 + 4 + 16
    assert reader.header_bytes + sum(info.bytes for info in reader.packets) + index == reader.total_bytes == len(data)
    assert all(info.bytes == sum(info.field_bytes.values()) + 12 + 8 + 4 for info in reader.packets)
    (described,) = struct.unpack_from("<I", data, 12 + 8)
    assert reader.header_field_bytes.keys() == reader.header.static.keys()
    assert reader.header_bytes == 12 + 8 + 4 + described + sum(reader.header_field_bytes.values()) + 4


def test_a_stream_cut_at_any_byte_plays_up_to_the_cut() -> None:
    data = small_stream()
    whole = StreamReader(data)
    scenes = [whole.scene(i) for i in range(len(whole))]
    ends = [whole.header_bytes, *(info.offset + info.bytes for info in whole.packets), len(data) - 16]
    between = range(0, len(data), 1 if THOROUGH else 8)
    for cut in sorted({*between, *(end + near for end in ends for near in (-1, 0, 1))}):
        if cut < whole.header_bytes:
            with pytest.raises(StreamError, match="cut at byte|ends at byte"):
                StreamReader(data[:cut])
            continue
        reader = StreamReader(data[:cut])
        expected = sum(info.offset + info.bytes <= cut for info in whole.packets)
        assert len(reader) == expected
        assert reader.complete == (cut >= len(data) - 16)
        if expected:
            assert same(reader.scene(expected - 1), scenes[expected - 1])


def test_unknown_records_are_skipped() -> None:
    data = small_stream()
    second = list(scan_records(data))[2]
    foreign = struct.pack("<BBHI", 77, 0, 0, 3) + b"abc"
    foreign += struct.pack("<I", zlib.crc32(foreign))
    reader = StreamReader(data[: second.offset] + foreign + data[second.offset :])
    assert len(reader) == 4
    assert same(reader.scene(3), StreamReader(data).scene(3))


def test_another_major_version_is_refused_and_a_newer_minor_is_not() -> None:
    data = small_stream()
    with pytest.raises(StreamError, match=r"format version 3\.0; this program reads 2\.x\. Install a newer"):
        StreamReader(data[:8] + struct.pack("<HH", 3, 0) + data[PREFIX.size :])
    with pytest.raises(StreamError, match=r"format version 1\.0; this program reads 2\.x\. Reconstruct it again"):
        StreamReader(data[:8] + struct.pack("<HH", 1, 0) + data[PREFIX.size :])
    assert len(StreamReader(data[:8] + struct.pack("<HH", 2, 9) + data[PREFIX.size :])) == 4


@pytest.mark.parametrize(
    ("records", "message"),
    [
        (
            [packet_record(1, PacketKind.KEY)],
            r"has packet 1 where packet 0 belongs\. If structgstream fit-group wrote it, join it",
        ),
        ([packet_record(0, PacketKind.DELTA)], "begins with a delta packet"),
        ([packet_record(0, PacketKind.KEY), packet_record(0, PacketKind.KEY)], "packet 0 where packet 1 belongs"),
        (
            [packet_record(0, PacketKind.KEY), packet_record(1, PacketKind.DELTA, pts_seconds=0.0)],
            "presentation time of packet 1 does not increase",
        ),
        ([packet_record(0, PacketKind.KEY, pts_seconds=float("nan"))], "it is damaged"),
        ([packed(RecordType.KEY, b"short")], "too short"),
        (
            [packed(RecordType.INIT, b"")],
            "init record of period 0, at byte {end}, where one of period 1, or a packet, belongs",
        ),
        ([packed(RecordType.INIT, b"", period=1)], "init record of period 1, at byte {end}, where a packet belongs"),
    ],
)
def test_records_that_contradict_each_other(records: list[bytes], message: str) -> None:
    end = len(with_records())  # How many digits the rig's numbers have depends on the processor.
    with pytest.raises(StreamError, match=message.format(end=end)):
        StreamReader(with_records(*records))


def test_a_frame_that_is_not_there() -> None:
    with pytest.raises(StreamError, match="has frames 0 to 3; there is no frame 4"):
        StreamReader(small_stream()).scene(4)
    with pytest.raises(StreamError, match="has no whole frame; there is no frame 0"):
        StreamReader(with_records()).scene(0)


def test_a_stream_that_begins_with_a_packet() -> None:
    with pytest.raises(StreamError, match="begins with a record of type 2"):
        StreamReader(prefix() + packet_record(0, PacketKind.KEY))


def test_files_that_are_no_streams(tmp_path: Path) -> None:
    empty, other = tmp_path / "empty.sgs", tmp_path / "other.sgs"
    empty.touch()
    other.write_text("A letter to someone.")
    for path, message in [
        (tmp_path, "has no manifest.json; expected a folder written with --sink segments"),
        (tmp_path / "missing.sgs", "Cannot read .*missing.sgs .No such file"),
        (empty, "empty.sgs is empty"),
        (other, "other.sgs is not a structgstream file"),
    ]:
        with pytest.raises(StreamError, match=message):
            open_stream(path)


def test_a_file_is_read_when_it_is_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "a.sgs"
    path.write_bytes(small_stream())
    whole = StreamReader(path.read_bytes())
    with open_stream(path) as reader:
        assert [*reader.packets] == [*whole.packets]
        assert reader.packets[-1] == reader.packets[3]
        assert reader.packets[1:] == [*whole.packets][1:]
        with pytest.raises(IndexError):
            reader.packets[4]
        assert same(reader.scene(2), whole.scene(2))
        os.truncate(path, whole.packets[2].offset + 10)
        assert same(reader.scene(1), whole.scene(1))
        for ask in (reader.scene, reader.packets.__getitem__):
            with pytest.raises(StreamError, match="a.sgs: it has become shorter"):
                ask(2)
    with pytest.raises(StreamError, match="has been closed"):
        reader.scene(0)


def test_a_file_that_became_another_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "a.sgs"
    path.write_bytes(data := small_stream())
    reader = open_stream(path)
    first, second = reader.packets[1:3]
    other = data[second.offset : second.offset + second.bytes]
    path.write_bytes(data[: first.offset] + other + data[first.offset + len(other) :])
    for ask in (reader.scene, reader.packets.__getitem__):
        with pytest.raises(StreamError, match="Packet 1 .* is damaged"):
            ask(1)


def test_a_scene_is_decoded_when_frame_or_back_end_change_and_not_before(monkeypatch: pytest.MonkeyPatch) -> None:
    sink, scenes, backend = MemorySink(), [moved(small_scene(free=2), step) for step in range(2)], reference_backend()
    write_stream(sink, scenes)
    reader, decoded = StreamReader(sink.data), list[int]()
    scene = reader.scene

    def counted(index: int) -> Scene:
        decoded.append(index)
        return scene(index)

    monkeypatch.setattr(reader, "scene", counted)
    first, second, *_ = reader.header.rig
    other = replace(backend, name="cpu")
    for index, name, asked in (
        (0, first, backend),
        (0, second, backend),
        (1, second, backend),
        (1, second, other),
        (1, first, other),
    ):
        picture = reader.render(index, name, backend=asked)
        expected = to_8bit_image(render(scene(index), reader.header.camera(name), backend).image)
        assert np.array_equal(picture, expected)
    assert decoded == [0, 1, 1]


def test_a_back_end_is_selected_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Selecting a slow one warns, which whoever renders all frames of a stream need not read for each of them."""
    backend, asked = reference_backend(), list[object]()

    def selected(name: object) -> Backend:
        asked.append(name)
        return backend

    monkeypatch.setattr("structgstream.codec.reader.select_backend", selected)
    reader = StreamReader(small_stream())
    for index in (0, 1, 0):
        reader.render(index, reader.header.rig.training[0])
    assert asked == ["auto"]

# SPDX-License-Identifier: Apache-2.0
"""Peers' files: round trip, cut anywhere, damaged anywhere."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from structgstream.cameras import Similarity
from structgstream.codec.container.records import scan_records
from structgstream.codec.packets import Packet, PacketKind, StreamHeader
from structgstream.errors import StorageError, StreamError
from structgstream.scene.state import STATE_TABLE
from structgstream_studies.peers.container import (
    PeerReader,
    PeerSink,
    packed_array,
    parse_packet,
    unpacked_arrays,
)
from structgstream_studies.peers.method import Arrays
from tests.support.rigs import arc_rig

HEADER = StreamHeader(
    rig=arc_rig(3),
    similarity=Similarity((1.0, 2.0, 3.0), 0.5),
    fps=25.0,
    codec="test",
    dynamic=frozenset(field.name for field in STATE_TABLE),
    static={},
    distance_input=False,
    config={"grid": {"levels": 3}, "rate": 0.1},
    metadata={"seed": 4},
)


@dataclass
class Keeps:
    """A method whose state is the list of all arrays so far."""

    stands_alone: bool = False

    def restored(self, arrays: Mapping[str, Any], previous: list | None, *, device: Any) -> list:
        return [*(previous or []), dict(arrays)]


def frame(i: int) -> Arrays:
    rng = np.random.default_rng(i)
    return {
        "half": rng.normal(size=(3, i + 1)).astype(np.float16),
        "single": rng.normal(size=(2, 2, 2)).astype(np.float32),
        "bytes": rng.integers(0, 256, size=5).astype(np.uint8),
        "ids": rng.integers(-9, 9, size=(i, 4)).astype(np.int64),
        "scalar": np.array(i, np.float32),
    }


def packet(i: int) -> Packet:
    return parse_packet(frame(i), index=i, pts_seconds=i / 25, kind=PacketKind.DELTA if i else PacketKind.KEY)


def broken_off(path: Path, *packets: Packet) -> bytes:
    """A file whose last frame is missing."""
    sink = PeerSink(path, frames=len(packets) + 1)
    sink.open(HEADER)
    for one in packets:
        sink.write(one)
    sink.close()
    return path.read_bytes()


def written(path: Path, frames: int = 3) -> bytes:
    sink = PeerSink(path, frames=frames)
    sink.open(HEADER)
    for i in range(frames):
        sink.write(packet(i))
    sink.close()
    sink.close()
    return path.read_bytes()


def read(data: bytes) -> PeerReader[Any]:
    return PeerReader(data, lambda _: Keeps())  # type: ignore[arg-type, return-value]


def equal(found: Mapping[str, Any], expected: Mapping[str, Any]) -> bool:
    return found.keys() == expected.keys() and all(
        found[name].dtype == value.dtype and found[name].shape == value.shape and np.array_equal(found[name], value)
        for name, value in expected.items()
    )


def test_a_file_gives_back_header_and_arrays(tmp_path: Path) -> None:
    data = written(tmp_path / "a.sgp")
    reader = read(data)
    assert reader.complete
    assert reader.header.config == HEADER.config
    assert reader.header.codec == "test"
    assert reader.header.similarity == HEADER.similarity
    assert reader.header.static == {}
    for i, (info, state) in enumerate(reader.scenes()):
        assert info.index == i
        assert len(state) == i + 1
        assert equal(state[-1], frame(i))
    assert reader.total_bytes == len(data)
    assert sum(info.bytes for info in reader.packets) + reader.header_bytes == reader.end
    assert sum(reader.packets[0].field_bytes.values()) == reader.packets[0].bytes - 12 - 12


def test_a_file_cut_anywhere_gives_the_frames_before(tmp_path: Path) -> None:
    data = written(tmp_path / "a.sgp")
    ends = [record.end for record in scan_records(data)]
    for cut in range(ends[0], len(data)):
        reader = read(data[:cut])
        assert not reader.complete
        assert reader.cut_reason is not None
        assert len(reader) == min(sum(end <= cut for end in ends) - 1, 3)
    with pytest.raises(StreamError, match="can be shown"):
        read(data[: ends[0] - 1])


def test_a_flipped_byte_ends_what_can_be_read(tmp_path: Path) -> None:
    data = written(tmp_path / "a.sgp")
    second = list(scan_records(data))[2]
    for at in range(second.offset, second.end, 7):
        broken = bytearray(data)
        broken[at] ^= 0x40
        reader = read(bytes(broken))
        assert len(reader) == 1
        assert equal(next(reader.scenes())[1][0], frame(0))


def test_other_files_are_refused(tmp_path: Path) -> None:
    data = written(tmp_path / "a.sgp")
    with pytest.raises(StreamError, match="signature"):
        read(b"\x89SGS" + data[4:])
    newer = bytearray(data)
    newer[8] = 2
    with pytest.raises(StreamError, match="version 2"):
        read(bytes(newer))


def test_frames_out_of_order_are_refused(tmp_path: Path) -> None:
    for index, pts, kind in ((1, 0.0, PacketKind.KEY), (0, 0.0, PacketKind.DELTA)):
        one = parse_packet(frame(0), index=index, pts_seconds=pts, kind=kind)
        with pytest.raises(StreamError):
            read(broken_off(tmp_path / "b.sgp", one))
    same_time = [parse_packet(frame(0), index=i, pts_seconds=0.0, kind=PacketKind.KEY) for i in range(2)]
    with pytest.raises(StreamError, match="not presented after"):
        read(broken_off(tmp_path / "b.sgp", *same_time))


def test_writing_goes_on_where_it_stopped(tmp_path: Path) -> None:
    path = tmp_path / "a.sgp"
    data = written(path)
    third = list(scan_records(data))[3]
    path.write_bytes(data[: third.offset + 9])
    sink = PeerSink(path, frames=3, resumed=read(path.read_bytes()))
    sink.open(HEADER)
    sink.write(packet(2))
    sink.close()
    assert path.read_bytes() == data


def test_only_a_whole_file_is_complete(tmp_path: Path) -> None:
    assert not read(broken_off(tmp_path / "a.sgp", packet(0), packet(1))).complete
    assert read(written(tmp_path / "a.sgp", 2)).complete


def test_a_folder_is_no_file(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match="Cannot open"):
        PeerSink(tmp_path, frames=1).open(HEADER)


@pytest.mark.parametrize("at", range(1, 20))
def test_an_array_that_is_cut_is_refused(at: int) -> None:
    block = packed_array("name", np.arange(3, dtype=np.int64))
    with pytest.raises(StreamError):
        unpacked_arrays(block[:at], 0, where="The frame")


def test_an_array_larger_than_its_record_is_refused_before_it_is_made() -> None:
    block = bytearray(packed_array("name", np.zeros((2, 2), np.float32)))
    block[8:12] = (2**31).to_bytes(4, "little")
    with pytest.raises(StreamError, match="more than it holds"):
        unpacked_arrays(bytes(block), 0, where="The frame")
    empty = bytearray(packed_array("name", np.zeros((0, 2), np.float32)))
    empty[12:16] = (2**32 - 1).to_bytes(4, "little")
    with pytest.raises(StreamError, match="more than it holds"):
        unpacked_arrays(bytes(empty), 0, where="The frame")


def test_an_array_that_comes_twice_and_one_of_no_known_type_are_refused() -> None:
    block = packed_array("name", np.zeros(1, np.float32))
    with pytest.raises(StreamError, match="twice"):
        unpacked_arrays(block + block, 0, where="The frame")
    with pytest.raises(StreamError, match="no place"):
        packed_array("name", np.zeros(1, np.complex64))
    with pytest.raises(StreamError, match="no place"):
        packed_array("", np.zeros(1, np.float32))

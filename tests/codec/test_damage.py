# SPDX-License-Identifier: Apache-2.0
"""Where a stream file that was cut can be continued. A flipped bit is reported with its record and costs at most its
group (docs/bitstream.md, section Damage)."""

import struct
import zlib
from functools import cache
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from structgstream.codec import contents
from structgstream.codec.container.records import PREFIX, RECORD, RecordType, prefix, scan_records
from structgstream.codec.contents import MIN_PACKET_BYTES, Damage, PacketSearch, Standing
from structgstream.codec.reader import StreamReader
from structgstream.codec.sinks import FileSink, MemorySink, readable_part
from structgstream.errors import StreamError
from structgstream.scene.scene import Scene
from tests.support.properties import examples
from tests.support.streams import compact_header, flipped, moved, same, small_scene, small_stream, write_stream

WHOLE = small_stream()
with StreamReader(WHOLE) as _reader:
    ENDS = [_reader.packets.at(i).offset + _reader.packets.at(i).bytes for i in range(len(_reader))]


@given(st.integers(PREFIX.size, ENDS[-2] - 1), st.integers(0, 7))
@examples(400)
def test_a_bit_that_flipped_never_costs_whole_frames(byte: int, bit: int) -> None:
    """Whatever it is in, the init record, a length, or a packet before the last: nothing after it is given up."""
    with pytest.raises(StreamError, match="^Cannot continue it: .* Keep a copy"):
        readable_part(flipped(WHOLE, 8 * byte + bit), name="it")


@pytest.mark.parametrize("power", range(32))
def test_a_flipped_bit_in_the_length_of_the_init_record_is_no_cut(power: int) -> None:
    """The record then seems to be longer than the file, as that of a writer that was killed at its start."""
    length = 8 * (PREFIX.size + RECORD.size - 4)
    with pytest.raises(StreamError, match="Cannot continue it"):
        readable_part(flipped(WHOLE, length + power), name="it")


def test_damage_at_the_end_is_a_write_that_was_interrupted() -> None:
    assert readable_part(flipped(WHOLE[: ENDS[-1]], 8 * ENDS[-1] - 8), name="it") == ENDS[-2]


@pytest.mark.parametrize("data", [b"", prefix()[:3], prefix()])
def test_what_was_hardly_begun_begins_again(data: bytes) -> None:
    assert readable_part(data, name="it") is None


FRAMES = 8
"""Three groups: key packets are 0, 3 and 6."""


@cache
def whole() -> tuple[bytes, list[Scene], list[int]]:
    """A stream with codec ``compact``, its scenes, and where its records begin: init, packets, index."""
    first = small_scene(3)
    sink = MemorySink()
    seen = write_stream(sink, [moved(first, i) for i in range(FRAMES)], header=compact_header(first))
    return sink.data, seen, [record.offset for record in scan_records(sink.data)]


def group(frame: int) -> range:
    return range(frame, min(frame // 3 * 3 + 3, FRAMES))


def check(reader: StreamReader, lost: set[int]) -> None:
    _, seen, _ = whole()
    for index in range(FRAMES):
        if index in lost:
            with pytest.raises(StreamError, match=f"Frame {index} of The stream is lost: the record at byte "):
                reader.scene(index)
        else:
            assert same(reader.scene(index), seen[index]), index


@pytest.mark.parametrize("frame", [0, 1, 5, 7])
def test_any_bit_of_a_packet_costs_what_is_left_of_its_group(frame: int) -> None:
    """Of heads every fifth bit, so that types, lengths, frames and times are wrong, and some of the rest."""
    data, _, offsets = whole()
    start, end = offsets[frame + 1 : frame + 3]
    for bit in (*range(8 * start + frame % 5, 8 * (start + 20), 5), *range(8 * (start + 20), 8 * end, 487)):
        reader = StreamReader(flipped(data, bit))
        assert reader.damage == [Damage(start, group(frame))], bit
        assert len(reader) == frame
        assert not reader.complete
        if bit % 20 == 0:
            assert len([*reader.scenes()]) == frame
            check(reader, {*group(frame)})


def test_what_is_said_of_damage() -> None:
    data, _, offsets = whole()
    reader = StreamReader(flipped(data, 8 * offsets[2] + 70))
    assert reader.runs == [range(1), range(3, FRAMES)]
    assert reader.cut_reason == (
        f"the record at byte {offsets[2]} of {len(data)} is damaged; 2 of 8 frames are lost, the first is 1, "
        "frame 3 can be shown again"
    )
    with pytest.raises(StreamError, match=f"Frame 2 .* at byte {offsets[2]}, where frame 1 should be, is damaged"):
        reader.scene(2)
    with pytest.raises(StreamError, match="has frames 0 to 7; there is no frame 8"):
        reader.scene(8)


def test_several_damages() -> None:
    data, _, offsets = whole()
    two, five = 8 * offsets[3] + 32, 8 * offsets[6] + 100
    reader = StreamReader(flipped(data, two, five))
    assert reader.runs == [range(2), range(3, 5), range(6, 8)]
    assert [damage.frames for damage in reader.damage] == [range(2, 3), range(5, 6)]
    check(reader, {2, 5})
    assert "is damaged, and 1 more; 2 of 8 frames are lost, the first is 2, frame 3 can" in (reader.cut_reason or "")
    # Two records side by side are one damage, for nothing tells where the second begins.
    reader = StreamReader(flipped(data, two, 8 * offsets[4] + 32))
    assert [damage.frames for damage in reader.damage] == [range(2, 6)]
    check(reader, {2, 3, 4, 5})


def test_damage_of_the_index_costs_nothing_and_of_the_last_packet_one_frame() -> None:
    data, _, offsets = whole()
    for bit in range(8 * offsets[-1], 8 * len(data), 101):
        reader = StreamReader(flipped(data, bit))
        assert (len(reader), reader.damage, reader.runs) == (FRAMES, [], [range(FRAMES)])
    without_index = flipped(data, 8 * offsets[-2] + 90)[: offsets[-1]]
    reader = StreamReader(without_index)
    assert (len(reader), reader.damage) == (FRAMES - 1, [])
    assert reader.cut_reason == f"the record at byte {offsets[-2]} of {offsets[-1]} is damaged"


def test_damage_of_what_is_no_packet_costs_no_frame() -> None:
    data, _, offsets = whole()
    foreign = RECORD.pack(77, 0, 0, 30) + bytes(30)
    foreign += struct.pack("<I", zlib.crc32(foreign) ^ 1)
    reader = StreamReader(data[: offsets[3]] + foreign + data[offsets[3] :])
    assert (len(reader), reader.damage) == (FRAMES, [Damage(offsets[3], range(2, 2))])
    assert reader.cut_reason.endswith("; no frame is lost")
    check(reader, set())


def test_raw_packets_stand_alone() -> None:
    data = small_stream(5)
    clean, offsets = StreamReader(data), [record.offset for record in scan_records(data)]
    reader = StreamReader(flipped(data, 8 * offsets[2] + 45))
    assert reader.runs == [range(1), range(2, 5)]
    assert all(same(reader.scene(i), clean.scene(i)) for i in (4, 0, 2, 3))


def test_a_stream_cut_after_damage() -> None:
    data, _, offsets = whole()
    mangled = flipped(data, 8 * offsets[2] + 32)
    for cut in range(offsets[2], len(data), 113):
        reader = StreamReader(mangled[:cut])
        arrived = sum(end <= cut for end in offsets[2:])
        runs = [range(1), *([range(3, arrived)] if arrived > 3 else [])]
        assert reader.runs == runs, cut


def test_frames_that_cannot_have_been_there_are_not_believed() -> None:
    """A packet far ahead would make room for all frames before it."""
    data, _, offsets = whole()
    start, end = offsets[4], offsets[5]
    far = bytearray(data[start:end])
    room = (start - offsets[3]) // MIN_PACKET_BYTES
    for index, believed in ((2**32 - 1, False), (2 + room + 1, False), (2 + room, True)):
        struct.pack_into("<I", far, RECORD.size, index)
        struct.pack_into("<I", far, len(far) - 4, zlib.crc32(far[:-4]))
        reader = StreamReader(flipped(data[:start], 8 * offsets[3] + 70) + bytes(far))
        assert (len(reader.packets.offsets) == 2 + room + 1) == believed
        assert len(reader.packets.offsets) < 20


def test_a_file_full_of_heads_does_not_keep_a_reader_busy(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every head of the file promises all the rest of it."""
    data, _, offsets = whole()
    rows = 20_000
    head = struct.pack("<BBHIId", RecordType.KEY, 0, 0, 10_000, 1, 9.0)
    hostile = data[: offsets[2]] + head * rows + bytes(10_000)
    read, read_record = [], contents.read_record
    monkeypatch.setattr(contents, "read_record", lambda *given: read.append(1) or read_record(*given))
    assert len(StreamReader(hostile)) == 1
    assert 0 < 10_000 * len(read) <= 4 * len(hostile)


def test_heads_across_pieces_of_a_search(monkeypatch: pytest.MonkeyPatch) -> None:
    data, _, offsets = whole()
    for size in (8, 9, 64, 1000):
        monkeypatch.setattr(contents, "_CHUNK_BYTES", size)
        found = PacketSearch(data).next(offsets[1], Standing(offsets[1], 0, 0.0))
        assert found.offset == offsets[2]


def test_a_stream_whose_lengths_are_wrong_is_not_cut_by_resuming(tmp_path: Path) -> None:
    data, _, offsets = whole()
    path = tmp_path / "damaged.sgs"
    path.write_bytes(flipped(data, 8 * offsets[2] + 8 * 7))  # the highest byte of the length
    with pytest.raises(StreamError, match="it is cut at byte .*, and continuing would overwrite the whole frames"):
        FileSink.resume(path)

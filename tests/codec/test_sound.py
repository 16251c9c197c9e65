# SPDX-License-Identifier: Apache-2.0
"""Sound in a stream: records, damage, cuts, and what is continued (docs/bitstream.md, section Sound)."""

import math
import struct
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from structgstream.codec.container.records import RecordType, packed, scan_records
from structgstream.codec.packets import Packet, PacketKind, PacketSink, pack_header, unpack_header
from structgstream.codec.reader import StreamReader
from structgstream.codec.segments.store import FolderStore
from structgstream.codec.segments.stored_bytes import write_archive
from structgstream.codec.sinks import FileSink, MemorySink, resume_segments
from structgstream.codec.sound import FrameSound, SoundFormat, frame_sound, sound_format, unpack_sound
from structgstream.errors import StreamError
from structgstream.opus import PACKET_SECONDS, OpusPacket, is_packet
from tests.support.streams import flipped, small_stream

SILENCE = bytes([0xF8, 0xFF, 0xFE])  # 20 ms
FRAMES = 4


def sounds() -> list[FrameSound]:
    """Of each frame; the third has none."""
    return [FrameSound(i, i / 30, (SILENCE,) * (0 if i == 2 else i + 1)) for i in range(FRAMES)]


def frames() -> tuple[list[Packet], StreamReader]:
    reader = StreamReader(small_stream(frames=FRAMES))
    packets = [[*reader.group(index)][-1] for index in range(FRAMES)]
    return [replace(one, sound=sound.pack()) for one, sound in zip(packets, sounds(), strict=True)], reader


def write(sink: PacketSink, *, start: int = 0, end: int = FRAMES) -> None:
    packets, reader = frames()
    sink.open(replace(reader.header, sound=SoundFormat(1)))
    for packet in packets[start:end]:
        sink.write(packet)


def whole_stream() -> bytes:
    sink = MemorySink()
    write(sink)
    sink.close()
    return sink.data


def test_each_frame_has_its_sound_beside_it_and_without_it_no_byte_more() -> None:
    data = whole_stream()
    for reader in (StreamReader(data), StreamReader(data, by_index=True)):
        assert reader.complete
        assert reader.header.sound == SoundFormat(1)
        assert [reader.sound(index) for index in range(FRAMES)] == sounds()
    plain = StreamReader(small_stream(frames=FRAMES))
    assert plain.sound(0) is None
    assert [one.bytes - two.bytes for one, two in zip(reader.packets, plain.packets, strict=True)] == [
        12 + len(sound.pack()) for sound in sounds()
    ]
    assert reader.packets[3].field_bytes["sound"] == 12 + len(sounds()[3].pack())
    assert [record.type for record in scan_records(data)][2::2] == [RecordType.SOUND] * FRAMES
    assert data[8:12] == bytes([2, 0, 2, 0])
    without = b"".join(packed(r.type, r.payload) for r in scan_records(data) if r.type in (2, 3))
    other = b"".join(packed(r.type, r.payload) for r in scan_records(small_stream(frames=FRAMES)) if r.type in (2, 3))
    assert without == other


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        struct.pack("<IdH", 0, 0.0, 1),
        struct.pack("<IdH", 0, float("nan"), 0),
        struct.pack("<IdHH", 0, 0.0, 1, 4) + SILENCE,
        struct.pack("<IdHH", 0, 0.0, 1, 3) + SILENCE + b"x",
        struct.pack("<IdHH", 0, 0.0, 1, 0),
        struct.pack("<IdHH", 0, 0.0, 1, 1) + b"\x00",  # 10 ms
        struct.pack("<IdHH", 0, 0.0, 1, 1300) + SILENCE + bytes(1297),
    ],
)
def test_what_is_no_sound(payload: bytes) -> None:
    with pytest.raises(StreamError, match="sound record"):
        unpack_sound(payload)


@pytest.mark.parametrize(
    ("packet", "expected"),
    [
        (bytes([0x08]), True),  # SILK, 20 ms
        (bytes([0x00]), False),  # 10 ms
        (bytes([0x01]), True),  # twice 10 ms
        (bytes([0x68]), True),  # hybrid, 20 ms
        (bytes([0x83, 8]), True),  # eight times 2.5 ms
        (bytes([0x83, 7]), False),
        (bytes([0x83]), False),
        (b"", False),
    ],
)
def test_the_length_of_a_packet(packet: bytes, expected: bool) -> None:
    assert is_packet(packet) is expected


def test_a_description_of_sound() -> None:
    assert sound_format(None) is None
    assert sound_format({"codec": "later", "channels": 9}) is None
    assert sound_format({"codec": "opus", "channels": 2}) == SoundFormat(2)
    for wrong in (3, {}, {"codec": "opus"}, {"codec": "opus", "channels": 3}, {"codec": "opus", "channels": True}):
        with pytest.raises(ValueError, match="sound"):
            sound_format(wrong)
    header = replace(frames()[1].header, sound=SoundFormat(2))
    assert unpack_header(pack_header(header)).sound == SoundFormat(2)


def test_packets_after_a_gap_begin_again() -> None:
    given = [OpusPacket(at, SILENCE) for at in (0.0, PACKET_SECONDS, 5.0, 5.0 + PACKET_SECONDS)]
    assert frame_sound(3, 1.0, given) == FrameSound(3, 5.0, (SILENCE, SILENCE))
    assert frame_sound(3, 1.0, []) == FrameSound(3, 1.0, ())


def test_a_damaged_sound_costs_no_frame() -> None:
    data = whole_stream()
    first = next(record for record in scan_records(data) if record.type == RecordType.SOUND)
    reader = StreamReader(flipped(data, 8 * (first.offset + 10)))
    assert len(reader) == FRAMES
    assert reader.cut_reason.endswith("no frame is lost")
    assert [reader.sound(i) for i in range(FRAMES)] == [None, *sounds()[1:]]
    assert reader.scene(FRAMES - 1) is not None


def test_a_sound_record_that_violates_the_format_costs_no_frame(caplog: pytest.LogCaptureFixture) -> None:
    records = [*scan_records(data := whole_stream())]
    first = next(record for record in records if record.type == RecordType.SOUND)
    wrong = packed(RecordType.SOUND, replace(sounds()[0], seconds=math.nan).pack())
    reader = StreamReader(data[: first.offset] + wrong + data[first.end : records[-1].offset])
    assert [reader.sound(index) for index in range(FRAMES)] == [None, *sounds()[1:]]
    assert "The sound record of frame 0 does not follow the format. The frame is silent." in caplog.text


def test_sound_is_found_behind_the_layers_of_a_packet() -> None:
    records = [*scan_records(data := whole_stream())]
    packet = next(record for record in records if record.type in (RecordType.KEY, RecordType.DELTA))
    between = packed(16, b"refines") + packed(64, b"a note")
    layered = StreamReader(data[: packet.end] + between + data[packet.end : records[-1].offset])
    assert [layered.sound(index) for index in range(FRAMES)] == sounds()
    assert layered.packets[0].bytes == StreamReader(data).packets[0].bytes + len(between)


def test_a_file_that_is_cut_anywhere_is_continued_to_the_same_bytes(tmp_path: Path) -> None:
    """Also between a packet and its sound: both are written at once, so neither was written."""
    whole = whole_stream()
    records = list(scan_records(whole))
    cuts = {cut for record in records for cut in (record.offset, record.offset + 9, record.end - 1, record.end)}
    for cut in sorted(cut for cut in cuts if cut <= records[-1].offset):
        path = tmp_path / f"{cut}.sgs"
        path.write_bytes(whole[:cut])
        sink, resumed = FileSink.resume(path)
        done = 0 if resumed is None else len(resumed)
        written = sum(record.end <= cut for record in records if record.type == RecordType.SOUND)
        assert done == written
        write(sink, start=done)
        sink.close()
        assert path.read_bytes() == whole


@pytest.mark.parametrize("end", range(1, FRAMES + 1))
def test_segments_are_the_bytes_of_the_file_also_continued(tmp_path: Path, end: int) -> None:
    store = FolderStore(tmp_path / "segments")
    store.prepare()
    sink, _ = resume_segments(store)
    write(sink, end=end)  # and is killed
    sink, found = resume_segments(store)
    assert [info.bytes for info in found.packets] == [info.bytes for info in StreamReader(whole_stream()).packets][:end]
    write(sink, start=end)
    sink.close()
    write_archive(store, tmp_path / "archive.sgs")
    assert (tmp_path / "archive.sgs").read_bytes() == whole_stream()


def stated(codec: str) -> Any:
    """A sound of a codec that this version does not know."""
    return SimpleNamespace(plain=lambda: {"codec": codec})


@pytest.mark.parametrize(
    ("first", "later", "same"),
    [
        (SoundFormat(1), SoundFormat(2), False),
        (None, stated("later"), False),
        (stated("later"), stated("another"), False),
        (stated("later"), stated("later"), True),
    ],
)
def test_periods_of_one_stream_have_one_sound(first: Any, later: Any, same: bool) -> None:
    packets, reader = frames()
    sink, header = MemorySink(), replace(reader.header, periods=True)
    sink.open(replace(header, sound=first))
    sink.write(packets[0])
    sink.begin(replace(header, sound=later))
    sink.write(replace(packets[1], kind=PacketKind.KEY))
    sink.close()
    with nullcontext() if same else pytest.raises(StreamError, match="other sound than the first"):
        assert StreamReader(sink.data).runs == [range(2)]

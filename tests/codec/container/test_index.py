# SPDX-License-Identifier: Apache-2.0
"""Opening by the index: the same packets without reading them, and a scan wherever the index cannot be believed."""

import struct
from collections.abc import Callable
from pathlib import Path

import pytest

from structgstream.codec.container.records import (
    FOOTER,
    FOOTER_MAGIC,
    INDEX_ENTRY,
    Record,
    RecordType,
    pack_index,
    packed,
    read_index,
    scan_records,
)
from structgstream.codec.reader import StreamReader, open_stream
from structgstream.errors import StreamError
from tests.support.streams import flipped, same, small_stream

STREAM = small_stream()
RECORDS = list(scan_records(STREAM))
START = RECORDS[0].end
ENTRIES = [*INDEX_ENTRY.iter_unpack(RECORDS[-1].payload)]


class Counted:
    """Bytes that count how many of them were asked for."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.read = 0

    def __len__(self) -> int:
        return len(self.data)

    def __getitem__(self, key: slice, /) -> bytes:
        piece = self.data[key]
        self.read += len(piece)
        return piece


def raw(record: Record) -> bytes:
    return STREAM[record.offset : record.end]


def with_index(body: bytes, entries: list[tuple[int, int, int]]) -> bytes:
    return body + pack_index(entries, len(body))


def test_by_index_everything_is_the_same() -> None:
    scan, index = StreamReader(STREAM), StreamReader(STREAM, by_index=True)
    assert [*scan.packets] == [*index.packets]
    assert (index.complete, index.cut_reason, index.header_bytes) == (True, None, scan.header_bytes)
    assert all(same(a, b) for (_, a), (_, b) in zip(scan.scenes(), index.scenes(), strict=True))


def test_by_index_packets_are_not_read() -> None:
    data = Counted(STREAM)
    index = read_index(data, START)
    assert [*index[0]] == [offset for _, _, offset in ENTRIES]
    assert data.read < 200 < min(len(record.payload) for record in RECORDS[1:5])


def test_records_of_unknown_types_lie_between_packets() -> None:
    body = STREAM[: RECORDS[2].offset] + struct.pack("<BBHI", 77, 0, 0, 3) + b"abc" + b"crc?"
    moved = [*ENTRIES[:1], *((i, kind, offset + 15) for i, kind, offset in ENTRIES[1:])]
    data = with_index(body + STREAM[RECORDS[2].offset : RECORDS[5].offset], moved)
    index = read_index(data, START)
    assert [*index[0]] == [offset for _, _, offset in moved]


BODY = STREAM[: RECORDS[5].offset]
DISBELIEVED: dict[str, Callable[[], bytes]] = {
    "no index": lambda: BODY,
    "no footer": lambda: STREAM[: -FOOTER.size],
    "cut footer": lambda: STREAM[:-1],
    "bytes after the footer": lambda: STREAM + b"\0",
    "footer before the packets": lambda: STREAM[:-16] + FOOTER.pack(START - 1, FOOTER_MAGIC),
    "footer behind the end": lambda: STREAM[:-16] + FOOTER.pack(2**63, FOOTER_MAGIC),
    "footer at a packet": lambda: STREAM[:-16] + FOOTER.pack(RECORDS[4].offset, FOOTER_MAGIC),
    "damaged index": lambda: STREAM[: RECORDS[5].offset + 9] + b"\xff" + STREAM[RECORDS[5].offset + 10 :],
    "an entry too few": lambda: with_index(BODY, ENTRIES[:-1]),
    "an entry too many": lambda: with_index(BODY, [*ENTRIES, (4, 3, RECORDS[4].offset)]),
    "a wrong offset": lambda: with_index(BODY, [*ENTRIES[:-1], (3, 2, ENTRIES[3][2] + 1)]),
    "a wrong type": lambda: with_index(BODY, [*ENTRIES[:-1], (3, 3, ENTRIES[3][2])]),
    "part of an entry": lambda: (
        BODY + packed(RecordType.INDEX, RECORDS[5].payload + b"\0") + FOOTER.pack(len(BODY), FOOTER_MAGIC)
    ),
    "a record that states another length": lambda: STREAM[: ENTRIES[1][2] + 4] + b"\x01" + STREAM[ENTRIES[1][2] + 5 :],
}


@pytest.mark.parametrize("case", DISBELIEVED)
def test_an_index_that_cannot_be_believed_is_not_used(case: str) -> None:
    data = DISBELIEVED[case]()
    assert read_index(data, START) is None
    by_index, scan = StreamReader(data, by_index=True), StreamReader(data)
    assert [*by_index.packets] == [*scan.packets]
    assert (by_index.complete, by_index.cut_reason) == (scan.complete, scan.cut_reason)


@pytest.mark.parametrize(
    "records",
    [
        [raw(RECORDS[2]), raw(RECORDS[1])],
        [packed(RecordType.DELTA, RECORDS[1].payload)],
        [raw(RECORDS[1]), raw(RECORDS[1])],
        [raw(RECORDS[1]), packed(RecordType.DELTA, struct.pack("<Id", 1, 0.0) + RECORDS[2].payload[12:])],
        [packed(RecordType.KEY, b"short")],
        [raw(RECORDS[0])],
    ],
    ids=["order", "delta first", "twice", "time", "short", "init"],
)
def test_records_that_contradict_each_other_are_left_to_the_scan(records: list[bytes]) -> None:
    body = STREAM[:START] + b"".join(records)
    assert read_index(with_index(body, []), START) is None
    with pytest.raises(StreamError):
        StreamReader(with_index(body, []), by_index=True)


def test_damage_shows_where_it_is_when_the_scene_is_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "damaged.sgs"
    path.write_bytes(flipped(STREAM, 8 * (ENTRIES[1][2] + 40)))
    reader = open_stream(path, by_index=True)
    assert (len(reader), len(open_stream(path))) == (4, 1)
    assert same(reader.scene(0), StreamReader(STREAM).scene(0))
    with pytest.raises(StreamError, match=r"Packet 1 of .*damaged.sgs, at byte \d+, is damaged"):
        reader.scene(1)
    scenes = reader.scenes()
    assert next(scenes)[0].index == 0
    with pytest.raises(StreamError, match="Packet 1 .* is damaged"):
        next(scenes)

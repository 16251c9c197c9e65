# SPDX-License-Identifier: Apache-2.0
"""Accounting of a stream's bytes by packet, field, kind of packet and header."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from structgstream.codec.packets import PacketKind
from structgstream.codec.reader import StreamReader

REST = "the rest"
"""Bytes that belong to no field: heads of records, checksums, and the header's JSON."""
FIRST = "first packet"
NOTHING = 0.01  # share of the header's size; a smaller first packet is left out of the parts
Parts = dict[str, dict[str, float]]
"""Bytes by field, including :data:`REST`, of named parts of a stream."""


@dataclass(frozen=True)
class Row:
    """One packet: ``kind`` is ``key`` or ``delta``; ``sizes`` are bytes by field and sum, with the rest, to its size.

    ``first`` is True if it begins a period.
    """

    index: int
    kind: str
    pts_seconds: float
    offset: int
    bytes: int
    sizes: Mapping[str, int]
    first: bool = False


@dataclass(frozen=True)
class Group:
    """Packets of one kind: their number, and their mean bytes in total and by field."""

    count: int
    bytes: float
    sizes: Mapping[str, float]


def packet_rows(reader: StreamReader) -> list[Row]:
    """The packet of every frame that can be decoded."""
    firsts = {period.first_frame for period in reader.periods}
    infos = (reader.packets.at(index) for run in reader.runs for index in run)
    return [
        Row(
            info.index,
            PacketKind(info.kind).name.lower(),
            info.pts_seconds,
            info.offset,
            info.bytes,
            with_rest(info.field_bytes, info.bytes),
            first=info.index in firsts,
        )
        for info in infos
    ]


def with_rest(sizes: Mapping[str, int], whole: int) -> dict[str, int]:
    """Bytes by field, with the remainder of ``whole`` as :data:`REST`."""
    return {**sizes, REST: whole - sum(sizes.values())}


def occurring_fields(sizes: Iterable[Mapping[str, float]]) -> list[str]:
    """The fields that occur, largest sum first, :data:`REST` last."""
    sums: dict[str, float] = {}
    for one in sizes:
        for name, size in one.items():
            sums[name] = sums.get(name, 0) + size
    return sorted(sums, key=lambda name: (name == REST, -sums[name]))


def groups_of(rows: Sequence[Row]) -> dict[str, Group]:
    """The first packet of each period, and the means of each kind of the others.

    First packets are a group of their own: with the codec ``compact`` they are nearly empty, because headers contain
    their frames.
    """
    chosen = {
        FIRST: [row for row in rows if row.first],
        "key packets": [row for row in rows if row.kind == "key" and not row.first],
        "delta packets": [row for row in rows if row.kind == "delta"],
    }
    return {name: mean_of(some) for name, some in chosen.items() if some}


def mean_of(rows: Sequence[Row]) -> Group:
    """The mean of at least one packet."""
    names = occurring_fields(row.sizes for row in rows)
    sizes = {name: sum(row.sizes.get(name, 0) for row in rows) / len(rows) for name in names}
    return Group(len(rows), sum(row.bytes for row in rows) / len(rows), sizes)


def parts_of(reader: StreamReader, rows: Sequence[Row]) -> Parts:
    """Bytes by field of the headers, and mean bytes of each kind of packet; a nearly empty first packet is left out."""
    parts: Parts = {"header": dict(with_rest(reader.header_field_bytes, reader.header_bytes))}
    for name, group in groups_of(rows).items():
        if name != FIRST or group.bytes > NOTHING * reader.header_bytes:
            parts[name] = dict(group.sizes)
    return parts

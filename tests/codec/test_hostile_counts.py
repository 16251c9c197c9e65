# SPDX-License-Identifier: Apache-2.0
"""Every count of a compact init record made as large as it can be: refused, and before memory is taken for it.

Packets have one count, of births, which ``test_free_rows.py`` looks at.
"""

import tracemalloc
from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

import numpy as np
import pytest
import torch

from structgstream.codec.container.blocks import BLOCK, first_block, iterate_blocks, unpack_blocks
from structgstream.codec.entropy import rans
from structgstream.codec.entropy.bits import varint
from structgstream.codec.entropy.rans import SectionDecoder
from structgstream.codec.fields.packet_fields import CODABLE
from structgstream.codec.fields.static_fields import decode_fields
from structgstream.codec.packets import PacketKind, StreamHeader, pack_header, unpack_header
from structgstream.codec.scene_coder import CompactCoder
from structgstream.errors import StreamError
from structgstream.scene.appearance import with_appearance
from structgstream.scene.state import FieldName, state_of
from tests.support.properties import thinned
from tests.support.streams import compact_header, small_scene

Fields = Mapping[FieldName, bytes]
HUGE = (2**20, 2**32 - 1)
MAX_BYTES = 48 * 2**20
"""What a decoder may take for a file of a few kilobytes: 2^20 numbers, in all that they are on the way."""
VALUES = ("origin", "descends", "middle")
"""Numbers that are no counts: as large as these is as good as any."""


class Count(NamedTuple):
    """A varint of a field's bytes, from byte ``start`` to before ``end``."""

    field: FieldName
    start: int
    end: int


def header_with_all() -> StreamHeader:
    """A header that has everything that can be there."""
    first = with_appearance(small_scene(2, free=3), 1)
    return compact_header(first, dynamic=CODABLE)


def counts_of(fields: Fields, decode: Callable[[Fields], object]) -> list[Count]:
    """Where decoding reads counts: numbers, and those in the heads of sections."""
    found: list[Count] = []
    number, read = SectionDecoder.number, rans.read_varint

    def logged_number(self: SectionDecoder, name: str, value: int | None) -> int:
        result = number(self, name, value)
        if name.endswith(VALUES):
            found.pop()
        return result

    def logged_read(data: memoryview, start: int = 0, *, where: str) -> tuple[int, int]:
        value, end = read(data, start, where=where)
        field: FieldName = next(known for known in fields if fields[known].endswith(bytes(data)))
        base = len(fields[field]) - len(data)
        found.append(Count(field, base + start, base + end))
        return value, end

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SectionDecoder, "number", logged_number)
        patch.setattr(rans, "read_varint", logged_read)
        decode(fields)
    return sorted({*found})


def enlarged(fields: Fields, counts: list[Count]) -> Iterator[tuple[Count, int, Fields]]:
    more = {*thinned(counts)}
    for count in counts:
        data = fields[count.field]
        # More than 32 bits are refused where any number is read.
        for value in (*HUGE, 2**35 - 1) if count in more else HUGE[:1]:
            yield count, value, {**fields, count.field: data[: count.start] + varint(value) + data[count.end :]}


def check_all_refused(fields: Fields, counts: list[Count], decode: Callable[[Fields], object]) -> None:
    tracemalloc.start()
    try:
        for count, value, changed in enlarged(fields, counts):
            tracemalloc.reset_peak()
            with pytest.raises(StreamError):
                print(count, value, decode(changed))
            assert tracemalloc.get_traced_memory()[1] < MAX_BYTES, (count, value)
    finally:
        tracemalloc.stop()


def test_counts_in_the_init_record() -> None:
    header = header_with_all()
    payload = pack_header(header)
    coded = unpack_blocks(payload, first_block(payload), where="")[1]
    fields: Fields = {name: bytes(data) for name, data in coded.items()}

    def decode(given: Fields) -> object:
        return decode_fields(given, header.init_steps)

    counts = counts_of(fields, decode)
    assert len(counts) > 80
    assert {count.field for count in counts} == fields.keys()
    check_all_refused(fields, counts, decode)


def test_sizes_in_blocks() -> None:
    payload = pack_header(header_with_all())
    tracemalloc.start()
    for block in iterate_blocks(payload, first_block(payload), where=""):
        for place in range(block.start + BLOCK.size, block.data, 4):
            for value in HUGE:
                tracemalloc.reset_peak()
                with pytest.raises(StreamError, match="The init record"):
                    unpack_header(payload[:place] + value.to_bytes(4, "little") + payload[place + 4 :])
                assert tracemalloc.get_traced_memory()[1] < MAX_BYTES
    tracemalloc.stop()


def test_as_many_free_gaussians_as_a_scene_may_have_take_bounded_memory() -> None:
    """They stand for the most that a few hundred bytes of a packet can."""
    first = small_scene(1)
    header = compact_header(first)
    state = dict(state_of(first))
    state["free"], state["free_births"] = torch.zeros(2**18, 14), torch.arange(2**18)
    fields = CompactCoder(header).encode(state, kind=PacketKind.KEY, index=0)
    assert sum(map(len, fields.values())) < 800
    tracemalloc.start()
    found = CompactCoder(header).decode(fields, kind=PacketKind.KEY, index=0)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert np.array_equal(found["free_births"].numpy(), np.arange(2**18))
    assert peak < 300 * 2**20

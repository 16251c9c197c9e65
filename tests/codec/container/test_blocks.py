# SPDX-License-Identifier: Apache-2.0
import struct

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from structgstream.codec.container.blocks import iterate_blocks, pack_raw_block, unpack_blocks
from structgstream.errors import StreamError


def block(code: int, coding: int, dtype: int, shape: tuple[int, ...], data: bytes = b"") -> bytes:
    return struct.pack(f"<BBBB{len(shape)}I", code, coding, dtype, len(shape), *shape) + data


def test_the_layout_of_a_block() -> None:
    value = torch.tensor([[1.0, -2.0, 0.5]])
    assert pack_raw_block("anchor_positions", value) == block(1, 0, 0, (1, 3), struct.pack("<3f", 1, -2, 0.5))
    births = torch.tensor([2**40, 7])
    assert pack_raw_block("free_births", births) == block(10, 0, 1, (2,), struct.pack("<2q", 2**40, 7))


@given(st.lists(st.integers(0, 5), max_size=4), st.integers(0, 2**32 - 1))
def test_every_bit_pattern_comes_back(shape: list[int], seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    bits = torch.randint(-(2**31), 2**31, tuple(shape), generator=generator, dtype=torch.int64).to(torch.int32)
    value = bits.view(torch.float32)  # NaN with payloads and subnormals among them
    payload = b"head" + pack_raw_block("free", value) + pack_raw_block("free_births", bits.long())
    found = unpack_blocks(payload, 4, where="Packet 0")[0]
    assert found["free"].shape == value.shape
    assert torch.equal(found["free"].view(torch.int32), bits)
    assert torch.equal(found["free_births"], bits.long())
    lengths = [b.end - b.start for b in iterate_blocks(payload, 4, where="Packet 0")]
    assert lengths == [4 + 4 * len(shape) + size * value.numel() for size in (4, 8)]


def test_doubles_and_strided_tensors_are_stored_as_floats_row_by_row() -> None:
    value = torch.arange(6, dtype=torch.float64).reshape(2, 3).T
    assert torch.equal(unpack_blocks(pack_raw_block("free", value), 0, where="x")[0]["free"], value.float())


@pytest.mark.parametrize(
    ("payload", "message"),
    [
        (b"\x01\x00\x00", "ends within the head"),
        (block(1, 0, 0, (1, 3))[:-1], "ends within the shape of field anchor_positions"),
        (block(1, 0, 0, (1, 3), bytes(11)), r"states \(1, 3\) numbers for field anchor_positions, more than"),
        (block(1, 0, 0, (2**32 - 1,) * 4), "more than it holds"),
        (block(1, 0, 0, (2**32 - 1, 2**32 - 1, 2**32 - 1, 0)), "more than it holds"),
        (block(1, 0, 1, (2**29, 3)), "more than it holds"),
        (block(99, 0, 0, (0,)), "field 99.* does not know"),
        (block(0, 0, 0, (0,)), "does not know"),
        (block(1, 1, 0, (0,)), "coding 1.* install a newer"),
        (block(1, 0, 2, (0,)), "type 2"),
        (block(1, 0, 0, (0,) * 5), "5 dimensions"),
        (block(1, 0, 0, (0, 3)) * 2, "holds field anchor_positions twice"),
    ],
)
def test_crafted_blocks(payload: bytes, message: str) -> None:
    with pytest.raises(StreamError, match=message):
        unpack_blocks(payload, 0, where="Packet 3")


@given(st.binary(max_size=80))
def test_arbitrary_bytes_give_tensors_or_one_kind_of_error(payload: bytes) -> None:
    try:
        found, _ = unpack_blocks(payload, 0, where="Packet 3")
    except StreamError:
        return
    assert sum(value.numel() for value in found.values()) * 4 <= len(payload)

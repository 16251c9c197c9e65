# SPDX-License-Identifier: Apache-2.0
import struct

import pytest
import torch
import zstandard

from structgstream.codec.container.blocks import (
    MAX_JSON_BYTES,
    field_sizes,
    first_block,
    pack_init,
    pack_raw_block,
    read_description,
)
from structgstream.errors import StreamError

BLOCKS = [pack_raw_block("anchor_positions", torch.zeros(2, 3)), pack_raw_block("anchor_features", torch.ones(2, 4))]


def test_description_and_blocks_come_back() -> None:
    description = {"b": [1, 0.5, None], "a": "ä"}
    payload = pack_init(description, BLOCKS)
    assert read_description(payload) == description
    assert payload[first_block(payload) :] == b"".join(BLOCKS)
    assert field_sizes(payload) == {"anchor_positions": len(BLOCKS[0]), "anchor_features": len(BLOCKS[1])}


def test_the_same_description_is_the_same_bytes() -> None:
    assert pack_init({"a": 1, "b": 2}, []) == pack_init({"b": 2, "a": 1}, [])


def test_a_description_that_unpacks_to_too_much_is_not_unpacked() -> None:
    bomb = zstandard.ZstdCompressor().compress(bytes(MAX_JSON_BYTES + 1))
    with pytest.raises(ValueError, match=f"unpacks to {MAX_JSON_BYTES + 1} bytes"):
        read_description(struct.pack("<I", len(bomb)) + bomb)
    stream = zstandard.ZstdCompressor().compressobj()
    unstated = stream.compress(b"{}") + stream.flush()
    with pytest.raises(ValueError, match="unpacks to -1 bytes"):
        read_description(struct.pack("<I", len(unstated)) + unstated)


@pytest.mark.parametrize("data", [b"", b"no frame of zstandard", zstandard.ZstdCompressor().compress(b"{")])
def test_what_is_no_description(data: bytes) -> None:
    with pytest.raises(ValueError, match=r"\w"):
        read_description(struct.pack("<I", len(data)) + data)


@pytest.mark.parametrize("cut", [0, 3, 4, 12])
def test_a_payload_that_is_cut(cut: int) -> None:
    with pytest.raises(StreamError, match="The init record"):
        first_block(pack_init({"a": 1}, BLOCKS)[:cut])


@pytest.mark.parametrize("text", [b'{"fps": NaN}', b'{"fps": Infinity}', b'{"fps": -Infinity}'])
def test_numbers_that_json_does_not_have_are_refused(text: bytes) -> None:
    packed = zstandard.ZstdCompressor().compress(text)
    with pytest.raises(ValueError, match="is no number of JSON"):
        read_description(struct.pack("<I", len(packed)) + packed)

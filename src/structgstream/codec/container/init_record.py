# SPDX-License-Identifier: Apache-2.0
"""The payload of an init record: packed JSON and field blocks (docs/bitstream.md, section Init record)."""

import json
import struct
from collections.abc import Iterable, Mapping
from typing import Any, NoReturn

from zstandard import ZstdCompressor, ZstdDecompressor, ZstdError, frame_content_size

from structgstream.codec.container.blocks import iterate_blocks
from structgstream.errors import StreamError

MAX_JSON_BYTES = 2**20
LENGTH = struct.Struct("<I")
_ZSTD_LEVEL = 19


def pack_init(description: Mapping[str, Any], blocks: Iterable[bytes]) -> bytes:
    """The payload of a description, which is plain JSON values, and blocks.

    Raises:
        StreamError: the description is too long.
    """
    text = json.dumps(description, sort_keys=True, allow_nan=False, separators=(",", ":")).encode()
    if len(text) > MAX_JSON_BYTES:
        raise StreamError(
            f"The header's description has {len(text)} bytes, at most {MAX_JSON_BYTES} are allowed; "
            "leave out metadata or cameras."
        )
    packed = ZstdCompressor(level=_ZSTD_LEVEL).compress(text)
    return LENGTH.pack(len(packed)) + packed + b"".join(blocks)


def first_block(payload: bytes) -> int:
    """The byte where the description ends and field blocks begin.

    Raises:
        StreamError: the payload is too short for it.
    """
    if len(payload) < LENGTH.size:
        raise StreamError("The init record is too short.")
    (length,) = LENGTH.unpack_from(payload)
    if LENGTH.size + length > len(payload):
        raise StreamError("The init record states a longer description than it holds.")
    return LENGTH.size + length


def read_description(payload: bytes) -> dict[str, Any]:
    """The description; its stated size is checked before anything is unpacked.

    Raises:
        StreamError: as :func:`first_block`.
        ValueError: it is too long, or not JSON.
    """
    packed = payload[LENGTH.size : first_block(payload)]
    try:
        size = frame_content_size(packed)
        if not 0 <= size <= MAX_JSON_BYTES:
            raise ValueError(f"its description unpacks to {size} bytes, at most {MAX_JSON_BYTES} are allowed")
        return json.loads(
            ZstdDecompressor().decompress(packed, max_output_size=MAX_JSON_BYTES), parse_constant=_refuse_constant
        )
    except ZstdError as error:
        raise ValueError(str(error)) from error


def field_sizes(payload: bytes) -> dict[str, int]:
    """Bytes of each field in the payload.

    Raises:
        StreamError: the payload violates the format.
    """
    blocks = iterate_blocks(payload, first_block(payload), where="The init record")
    return {block.name: block.end - block.start for block in blocks}


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is no number of JSON")

# SPDX-License-Identifier: Apache-2.0
"""Field blocks, a tensor each, and the payload of an init record (docs/bitstream.md, section Field blocks).

Coding 0 (``raw``) stores little-endian numbers: float32, or int64 for identities. Coding 1 (``coded``) stores bytes
that are defined by the stream's codec.
"""

import json
import math
import struct
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NoReturn

import numpy as np
import torch
from torch import Tensor
from zstandard import ZstdCompressor, ZstdDecompressor, ZstdError, frame_content_size

from structgstream.codec.container.byte_source import ByteSource
from structgstream.errors import StreamError
from structgstream.scene.state import STATE_TABLE, FieldName

BLOCK = struct.Struct("<BBBB")  # field code, coding, dtype, number of dimensions
RAW, CODED = 0, 1
MAX_DIMENSIONS = 4
MAX_ELEMENTS = 2**31 - 1
_DTYPES = {0: np.dtype("<f4"), 1: np.dtype("<i8")}
_BYTES = np.dtype("u1")
_OF_CODING = {RAW: _DTYPES, CODED: {2: _BYTES}}
_NAMES: dict[int, FieldName] = {field.code: field.name for field in STATE_TABLE}
_CODES: dict[FieldName, int] = {field.name: field.code for field in STATE_TABLE}


@dataclass(frozen=True)
class Block:
    """Offsets of one field in a payload: of its block, of its data, and of the byte after it.

    The stated sizes have been checked against the payload; nothing is copied.
    """

    name: FieldName
    coding: int
    dtype: np.dtype
    shape: tuple[int, ...]
    start: int
    data: int
    end: int


def pack_raw_block(name: FieldName, value: Tensor) -> bytes:
    """One field, coded raw."""
    array = value.detach().cpu().contiguous().numpy()
    code = 1 if array.dtype == np.int64 else 0
    array = np.asarray(array, dtype=_DTYPES[code], order="C")
    head = BLOCK.pack(_CODES[name], RAW, code, array.ndim)
    return head + struct.pack(f"<{array.ndim}I", *array.shape) + array.tobytes()


def pack_blocks(values: Mapping[FieldName, Tensor], coded: Mapping[FieldName, bytes]) -> dict[FieldName, bytes]:
    """The blocks of fields, in the order of the state table: coded where ``coded`` has their bytes, otherwise raw."""
    blocks: dict[FieldName, bytes] = {}
    for name, code in _CODES.items():
        if name in values and name in coded:
            blocks[name] = BLOCK.pack(code, CODED, 2, 1) + struct.pack("<I", len(coded[name])) + coded[name]
        elif name in values:
            blocks[name] = pack_raw_block(name, values[name])
    return blocks


def iterate_blocks(payload: ByteSource, start: int, *, where: str) -> Iterator[Block]:
    """Every block from byte ``start`` to the end. Raises StreamError for an unknown field or coding, a
    repeated field, or a size beyond the payload."""
    seen: set[int] = set()
    while start < len(payload):
        if start + BLOCK.size > len(payload):
            raise StreamError(f"{where} ends within the head of a field block.")
        code, coding, dtype, dimensions = BLOCK.unpack(payload[start : start + BLOCK.size])
        known = code in _NAMES and dtype in _OF_CODING.get(coding, {}) and dimensions <= MAX_DIMENSIONS
        if not known or (coding == CODED and dimensions != 1):
            raise StreamError(
                f"{where} holds a field block (field {code}, coding {coding}, type {dtype}, {dimensions} dimensions) "
                "that this version does not know; install a newer structgstream."
            )
        if code in seen:
            raise StreamError(f"{where} holds field {_NAMES[code]} twice.")
        seen.add(code)
        data = start + BLOCK.size + 4 * dimensions
        if data > len(payload):
            raise StreamError(f"{where} ends within the shape of field {_NAMES[code]}.")
        shape = struct.unpack(f"<{dimensions}I", payload[start + BLOCK.size : data])
        found = _OF_CODING[coding][dtype]
        end = data + math.prod(shape) * found.itemsize
        # An empty tensor has no bytes to be checked against, so its other sizes get a bound of their own.
        if end > len(payload) or math.prod(max(size, 1) for size in shape) > MAX_ELEMENTS:
            raise StreamError(f"{where} states {shape} numbers for field {_NAMES[code]}, more than it holds.")
        yield Block(_NAMES[code], coding, found, shape, start, data, end)
        start = end


def unpack_blocks(
    payload: bytes, start: int, *, where: str
) -> tuple[dict[FieldName, Tensor], dict[FieldName, memoryview]]:
    """The tensors of the raw blocks, and the bytes of the coded ones, from byte ``start`` to the end. Raises
    StreamError as :func:`iterate_blocks`."""
    values: dict[FieldName, Tensor] = {}
    coded: dict[FieldName, memoryview] = {}
    for block in iterate_blocks(payload, start, where=where):
        if block.coding == RAW:
            array = np.frombuffer(payload, dtype=block.dtype, count=math.prod(block.shape), offset=block.data)
            values[block.name] = torch.from_numpy(array.reshape(block.shape).astype(block.dtype.newbyteorder("=")))
        else:
            coded[block.name] = memoryview(payload)[block.data : block.end]
    return values, coded


MAX_JSON_BYTES = 2**20
LENGTH = struct.Struct("<I")
_ZSTD_LEVEL = 19


def pack_init(description: Mapping[str, Any], blocks: Iterable[bytes]) -> bytes:
    """The payload of a description, which is plain JSON values, and blocks. Raises StreamError if the description is
    too long."""
    text = json.dumps(description, sort_keys=True, allow_nan=False, separators=(",", ":")).encode()
    if len(text) > MAX_JSON_BYTES:
        raise StreamError(
            f"The header's description has {len(text)} bytes, at most {MAX_JSON_BYTES} are allowed; "
            "leave out metadata or cameras."
        )
    packed = ZstdCompressor(level=_ZSTD_LEVEL).compress(text)
    return LENGTH.pack(len(packed)) + packed + b"".join(blocks)


def first_block(payload: bytes) -> int:
    """The byte where the description ends and field blocks begin. Raises StreamError if the payload is too short for
    it."""
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
        text = ZstdDecompressor().decompress(packed, max_output_size=MAX_JSON_BYTES, allow_extra_data=False)
        return json.loads(text.decode(), parse_constant=_refuse_constant)  # Of bytes it would guess the encoding.
    except ZstdError as error:
        raise ValueError(str(error)) from error


def field_sizes(payload: bytes) -> dict[str, int]:
    """Bytes of each field in the payload. Raises StreamError if the payload violates the format."""
    blocks = iterate_blocks(payload, first_block(payload), where="The init record")
    return {block.name: block.end - block.start for block in blocks}


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is no number of JSON")

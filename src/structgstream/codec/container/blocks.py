# SPDX-License-Identifier: Apache-2.0
"""Field blocks: one tensor of the scene as bytes (docs/bitstream.md, section Field blocks).

Coding 0 (``raw``) stores little-endian numbers: float32, or int64 for identities. Coding 1 (``coded``) stores bytes
that are defined by the stream's codec.
"""

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

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


def pack_coded_block(name: FieldName, data: bytes) -> bytes:
    """One field, coded."""
    return BLOCK.pack(_CODES[name], CODED, 2, 1) + struct.pack("<I", len(data)) + data


def iterate_blocks(payload: ByteSource, start: int, *, where: str) -> Iterator[Block]:
    """Every block from byte ``start`` to the end.

    Raises:
        StreamError: an unknown field or coding, a repeated field, or a size beyond the payload.
    """
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


def unpack_raw_blocks(payload: bytes, start: int, *, where: str) -> dict[FieldName, Tensor]:
    """The tensors of all blocks from byte ``start`` to the end.

    Raises:
        StreamError: as :func:`iterate_blocks`.
    """
    values: dict[FieldName, Tensor] = {}
    for block in iterate_blocks(payload, start, where=where):
        if block.coding != RAW:
            raise StreamError(f"{where} holds field {block.name} coded; expected raw.")
        values[block.name] = _numbers(payload, block)
    return values


def unpack_blocks(
    payload: bytes, start: int, *, where: str
) -> tuple[dict[FieldName, Tensor], dict[FieldName, memoryview]]:
    """The tensors of the raw blocks, and the bytes of the coded ones, from byte ``start`` to the end.

    Raises:
        StreamError: as :func:`iterate_blocks`.
    """
    values: dict[FieldName, Tensor] = {}
    coded: dict[FieldName, memoryview] = {}
    for block in iterate_blocks(payload, start, where=where):
        if block.coding == RAW:
            values[block.name] = _numbers(payload, block)
        else:
            coded[block.name] = memoryview(payload)[block.data : block.end]
    return values, coded


def coded_payloads(payload: bytes, start: int, *, where: str) -> dict[FieldName, memoryview]:
    """The bytes of all blocks from byte ``start`` to the end, which must be coded.

    Raises:
        StreamError: as :func:`iterate_blocks`, or a block is raw.
    """
    found: dict[FieldName, memoryview] = {}
    for block in iterate_blocks(payload, start, where=where):
        if block.coding != CODED:
            raise StreamError(f"{where} holds field {block.name} raw; expected coded.")
        found[block.name] = memoryview(payload)[block.data : block.end]
    return found


def _numbers(payload: bytes, block: Block) -> Tensor:
    array = np.frombuffer(payload, dtype=block.dtype, count=math.prod(block.shape), offset=block.data)
    return torch.from_numpy(array.reshape(block.shape).astype(block.dtype.newbyteorder("=")))

# SPDX-License-Identifier: Apache-2.0
"""Field blocks: one tensor of the scene as bytes (docs/bitstream.md, section Field blocks).

Coding 0 (``raw``) stores the little-endian numbers as they are: float32, or int64 for identities.
"""

import math
import struct

import numpy as np
import torch
from torch import Tensor

from structgstream.errors import StreamError
from structgstream.scene.state import STATE_TABLE, FieldName

BLOCK = struct.Struct("<BBBB")  # field code, coding, dtype, number of dimensions
RAW = 0
MAX_DIMENSIONS = 4
_DTYPES = {0: np.dtype("<f4"), 1: np.dtype("<i8")}
_NAMES: dict[int, FieldName] = {field.code: field.name for field in STATE_TABLE}
_CODES: dict[FieldName, int] = {field.name: field.code for field in STATE_TABLE}


def packed_block(name: FieldName, value: Tensor) -> bytes:
    """One field, coded raw."""
    array = value.detach().cpu().contiguous().numpy()
    code = 1 if array.dtype == np.int64 else 0
    array = np.ascontiguousarray(array, dtype=_DTYPES[code])
    head = BLOCK.pack(_CODES[name], RAW, code, array.ndim)
    return head + struct.pack(f"<{array.ndim}I", *array.shape) + array.tobytes()


def unpacked_blocks(payload: bytes, start: int, *, where: str) -> tuple[dict[FieldName, Tensor], dict[FieldName, int]]:
    """All blocks from byte ``start`` to the end: their tensors and their lengths in bytes.

    Raises:
        StreamError: an unknown field or coding, or a size that does not fit the payload.
    """
    values: dict[FieldName, Tensor] = {}
    lengths: dict[FieldName, int] = {}
    offset = start
    while offset < len(payload):
        if offset + BLOCK.size > len(payload):
            raise StreamError(f"{where} ends within the head of a field block.")
        code, coding, dtype, dimensions = BLOCK.unpack_from(payload, offset)
        if code not in _NAMES or coding != RAW or dtype not in _DTYPES or dimensions > MAX_DIMENSIONS:
            raise StreamError(
                f"{where} holds a field block (field {code}, coding {coding}, type {dtype}, {dimensions} dimensions) "
                "that this version does not know; install a newer structgstream."
            )
        data_start = offset + BLOCK.size + 4 * dimensions
        if data_start > len(payload):
            raise StreamError(f"{where} ends within the shape of field {_NAMES[code]}.")
        shape = struct.unpack_from(f"<{dimensions}I", payload, offset + BLOCK.size)
        count = math.prod(shape)
        end = data_start + count * _DTYPES[dtype].itemsize
        if end > len(payload):
            raise StreamError(f"{where} states {shape} numbers for field {_NAMES[code]}, more than it holds.")
        array = np.frombuffer(payload, dtype=_DTYPES[dtype], count=count, offset=data_start).reshape(shape)
        values[_NAMES[code]] = torch.from_numpy(array.astype(array.dtype.newbyteorder("=")))
        lengths[_NAMES[code]] = end - offset
        offset = end
    return values, lengths

# SPDX-License-Identifier: Apache-2.0
"""Signed residuals as symbols of an alphabet of 16, with escape codes for the rare large ones (docs/entropy.md)."""

import numpy as np
from numpy.typing import NDArray

from structgstream.codec.entropy.bits import BitReader, fixed, golomb, pack_bits, unzigzag, zigzag
from structgstream.errors import StreamError

ALPHABET = 16
LARGEST = 7
ESCAPE = 15
_ORDER = 2
_MOST_ZEROS = 28


def residuals_to_symbols(residuals: NDArray[np.integer]) -> tuple[NDArray[np.uint8], bytes]:
    """Symbols u8 ``[n]`` (0, -1, 1, -2, 2 ... 7 are 0 to 14; 15 is any other) and the others' values.

    Args:
        residuals: integers ``[n]`` that int32 can hold.

    Raises:
        StreamError: one is out of int32's range.
    """
    values = residuals.astype(np.int64)
    if len(values) and (int(values.min()) < -(2**31) or int(values.max()) >= 2**31):
        raise StreamError("A residual is beyond 32 bits; take a larger quantization step.")
    size = np.abs(values)
    symbols = np.where(size > LARGEST, ESCAPE, zigzag(values)).astype(np.uint8)
    large = values[size > LARGEST].tolist()
    return symbols, pack_bits(golomb(abs(v) - LARGEST - 1, order=_ORDER) + fixed(v < 0, 1) for v in large)


def symbols_to_residuals(
    symbols: NDArray[np.uint8], escapes: bytes | memoryview, *, where: str = "A section of escapes"
) -> NDArray[np.int32]:
    """Inverse of :func:`residuals_to_symbols`: residuals int32 ``[n]``.

    Raises:
        StreamError: a symbol is above 15, the number of values differs from that of escapes, or a value is beyond 32
            bits.
    """
    if (symbols > ESCAPE).any():
        raise StreamError(f"{where} belongs to symbols above {ESCAPE}; they are damaged.")
    values = unzigzag(symbols.astype(np.int64))
    places = np.flatnonzero(symbols == ESCAPE)
    # An escape takes 4 to 61 bits.
    if not 4 * len(places) <= 8 * len(escapes) <= 61 * len(places) + 7:
        raise StreamError(f"{where} has {len(escapes)} bytes for {len(places)} values; it is damaged.")
    reader = BitReader(escapes, where=where)
    for place in places:
        magnitude = reader.golomb(order=_ORDER, most_zeros=_MOST_ZEROS) + LARGEST + 1
        negative = reader.fixed(1)
        if magnitude > 2**31 - 1 + negative:
            raise StreamError(f"{where} holds a value beyond 32 bits; it is damaged.")
        values[place] = -magnitude if negative else magnitude
    reader.end()
    return values.astype(np.int32)

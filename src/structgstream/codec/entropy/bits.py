# SPDX-License-Identifier: Apache-2.0
"""Integers as bits and bytes (docs/entropy.md, section Bits)."""

from collections.abc import Iterable
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from structgstream.errors import StreamError

Bins = NDArray[np.int32]
Naturals = NDArray[np.int64]
Flags = NDArray[np.bool_]
Contexts = NDArray[np.uint16]
Whole = TypeVar("Whole", int, NDArray[np.int64])


def pack_bits(pieces: Iterable[str]) -> bytes:
    """Concatenates strings of ``0`` and ``1`` to bytes, the last padded with zeros."""
    text = "".join(pieces)
    size = -(-len(text) // 8)
    return int(text.ljust(8 * size, "0") or "0", 2).to_bytes(size, "big")


def fixed(value: int, width: int) -> str:
    """A number in ``width`` bits."""
    return f"{value:0{width}b}"


def signed_golomb(value: int, *, order: int) -> str:
    """Exp-Golomb of the index ``i`` of ``value`` in 0, -1, 1, -2, 2 ...: the binary digits of ``i + 2^order``, after
    one zero for each digit beyond ``order + 1``."""
    digits = f"{zigzag(value) + (1 << order):b}"
    return "0" * (len(digits) - order - 1) + digits


def varint(value: int) -> bytes:
    """LEB128 of a number from 0 to 2^32 - 1: seven bits per byte, lowest first; the high bit marks that more follow."""
    out = bytearray()
    while value >= 128:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])


def read_varint(data: bytes | memoryview, start: int = 0, *, where: str) -> tuple[int, int]:
    """The number that :func:`varint` wrote at byte ``start``, and where it ends. Raises StreamError if it is cut, or
    beyond 32 bits."""
    value = 0
    for place, byte in enumerate(data[start : start + 5]):
        value |= (byte & 127) << 7 * place
        if byte < 128 and value < 2**32:
            return value, start + place + 1
    raise StreamError(f"{where} holds a number that is cut or beyond 32 bits; it is damaged.")


def zigzag(values: Whole) -> Whole:
    """Indices of values (63 bits) in 0, -1, 1, -2, 2 ..."""
    return values << 1 ^ values >> 63


def unzigzag(places: Whole) -> Whole:
    """Inverse of :func:`zigzag`."""
    return places >> 1 ^ -(places & 1)


def bit_lengths(values: NDArray[np.int64]) -> NDArray[np.int64]:
    """Number of binary digits, 0 for 0."""
    return np.frexp(values.astype(np.float64))[1].astype(np.int64)  # exact below 2^53


def unpack_numbers(data: bytes | memoryview, widths: NDArray[np.int64], *, where: str) -> NDArray[np.int64]:
    """Numbers int64 ``[n]`` with widths ``[n]`` of 0 to 56 bits that fill ``data`` up to zero padding in the last byte.
    Raises StreamError if there are fewer or more bytes, or the padding is not zero."""
    ends = np.cumsum(widths)
    bits = int(ends[-1]) if len(ends) else 0
    if len(data) != -(-bits // 8) or (bits % 8 and data[-1] & 0xFF >> bits % 8):
        raise StreamError(f"{where} has {len(data)} bytes for {bits} bits of numbers; it is damaged.")
    starts = ends - widths
    # The eight bytes from the byte where a number starts contain all of it.
    stored = np.frombuffer(bytes(data) + bytes(8), np.uint8)
    words = np.lib.stride_tricks.sliding_window_view(stored, 8)[starts >> 3]
    found = np.ascontiguousarray(words).view(">u8")[:, 0].astype(np.uint64) << (starts & 7).astype(np.uint64)
    return np.where(widths > 0, found >> (64 - np.maximum(widths, 1)).astype(np.uint64), 0).astype(np.int64)


class BitReader:
    """Reads what :func:`pack_bits` wrote; the caller bounds the number of bytes."""

    def __init__(self, data: bytes | memoryview, *, where: str) -> None:
        self._text = f"{int.from_bytes(data, 'big'):0{8 * len(data)}b}" if len(data) else ""
        self._position = 0
        self._where = where

    def fixed(self, width: int) -> int:
        """The next ``width`` bits as a number. Raises StreamError if there are fewer."""
        end = self._position + width
        if end > len(self._text):
            raise StreamError(f"{self._where} ends within a number; it is damaged.")
        value = int(self._text[self._position : end] or "0", 2)
        self._position = end
        return value

    def signed_golomb(self, *, order: int, max_zeros: int) -> int:
        """What :func:`signed_golomb` wrote, with at most ``max_zeros`` leading zeros. Raises StreamError if it has
        more, or is truncated."""
        first = self._text.find("1", self._position, self._position + max_zeros + 1)
        if first < 0:
            raise StreamError(f"{self._where} holds a number that is cut or out of bounds; it is damaged.")
        zeros, self._position = first - self._position, first
        return unzigzag(self.fixed(zeros + order + 1) - (1 << order))

    def end(self) -> None:
        """Checks that only zero padding of the last byte is left. Raises StreamError if more is left."""
        rest = self._text[self._position :]
        if len(rest) > 7 or "1" in rest:
            raise StreamError(f"{self._where} goes on after its last number; it is damaged.")

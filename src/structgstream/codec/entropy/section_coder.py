# SPDX-License-Identifier: Apache-2.0
"""Coders of the init record's sections, with one description of the format for both directions.

Note [Two directions]
~~~~~~~~~~~~~~~~~~~~~
A format is described once, as a function that passes values to a :data:`SectionCoder` and continues with what it
returns. An encoder gets the true values and returns them; a decoder gets None and returns the decoded values. So both
directions use the same order and contexts. This module codes the init record, ``adaptive.py`` packets.
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from structgstream.codec.entropy.bits import (
    ALPHABET,
    Bins,
    Contexts,
    Naturals,
    bit_lengths,
    fixed,
    pack_bits,
    residuals_to_symbols,
    symbols_to_residuals,
    unpack_numbers,
    varint,
)
from structgstream.codec.entropy.rans import decode, encode, section_bytes
from structgstream.codec.entropy.tables import FrequencyTables, choose_tables, decode_tables, geometric_family
from structgstream.errors import StreamError
from structgstream.scene.state import FieldName

CLASSES = 32
"""Alphabet of the bit lengths of natural numbers below 2^31."""
_FLAT = 128  # the geometric row that a context starts with


class SectionEncoder:
    """Encodes arrays of integers, one section after another; a name selects the frequency tables.

    The part of a name before the dot is the field of :attr:`fields` that the bytes are appended to.
    """

    def __init__(self) -> None:
        self._tables: dict[str, FrequencyTables] = {}
        self.fields: dict[str, bytes] = {}

    def residuals(self, name: str, values: Bins | None, contexts: Contexts, *, count: int) -> Bins:
        """Small signed numbers ``[n]``: entropy-coded symbols from -7 to 7, escape codes for larger ones."""
        assert values is not None
        symbols, escapes = residuals_to_symbols(values)
        self._section(name, symbols, contexts, count=count, alphabet=ALPHABET)
        self._put(name, varint(len(escapes)) + escapes)
        return values

    def naturals(self, name: str, values: Naturals | None, contexts: Contexts, *, count: int) -> Naturals:
        """Numbers ``[n]`` from 0 to 2^31 - 1: entropy-coded bit length, then the bits below the highest."""
        assert values is not None
        if len(values) and not 0 <= int(values.min()) <= int(values.max()) < 2**31:
            raise StreamError("A number is beyond 31 bits; take a larger quantization step.")
        lengths = bit_lengths(values)
        self._section(name, lengths.astype(np.uint8), contexts, count=count, alphabet=CLASSES)
        rest = pack_bits(
            fixed(int(value) - (1 << int(size) - 1), int(size) - 1) for value, size in zip(values, lengths) if size > 1
        )
        self._put(name, rest)
        return values

    def number(self, name: str, value: int | None) -> int:
        """One number from 0 to 2^32 - 1."""
        assert value is not None
        self._put(name, varint(value))
        return value

    def _section(self, name: str, symbols: NDArray[np.uint8], contexts: Contexts, *, count: int, alphabet: int) -> None:
        counts = np.zeros((count, alphabet), np.int64)
        np.add.at(counts, (contexts, symbols), 1)
        tables, packed = choose_tables(counts, _last(self._tables, name, count, alphabet))
        self._tables[name] = tables
        self._put(name, varint(len(packed)) + packed + encode(symbols, contexts, tables))

    def _put(self, name: str, data: bytes) -> None:
        field = name.partition(".")[0]
        self.fields[field] = self.fields.get(field, b"") + data


class SectionDecoder:
    """Reads what :class:`SectionEncoder` wrote into the fields."""

    def __init__(self, fields: Mapping[FieldName, bytes | memoryview], *, where: str) -> None:
        self._tables: dict[str, FrequencyTables] = {}
        self._left: dict[str, memoryview] = {name: memoryview(data) for name, data in fields.items()}
        self._where = where

    def residuals(self, name: str, values: Bins | None, contexts: Contexts, *, count: int) -> Bins:
        symbols = self._section(name, contexts, count=count, alphabet=ALPHABET)
        return symbols_to_residuals(
            symbols, self._taken(name, self.number(name, None)), where=f"{self._where}, {name},"
        )

    def naturals(self, name: str, values: Naturals | None, contexts: Contexts, *, count: int) -> Naturals:
        sizes = self._section(name, contexts, count=count, alphabet=CLASSES).astype(np.int64)
        widths = np.maximum(sizes - 1, 0)
        rest = unpack_numbers(self._taken(name, -(-int(widths.sum()) // 8)), widths, where=f"{self._where}, {name},")
        return np.where(sizes > 0, (1 << widths) + rest, 0)

    def number(self, name: str, value: int | None) -> int:
        found = shift = 0
        while True:
            (byte,) = self._taken(name, 1)
            found |= (byte & 127) << shift
            shift += 7
            if byte < 128:
                break
            if shift > 28:
                raise StreamError(f"{self._where}, {name}, holds a number beyond 32 bits; it is damaged.")
        if found >= 2**32:
            raise StreamError(f"{self._where}, {name}, holds a number beyond 32 bits; it is damaged.")
        return found

    def end(self) -> None:
        """Checks that all bytes have been read. Raises StreamError if some have not."""
        if left := [name for name, data in self._left.items() if len(data)]:
            raise StreamError(f"{self._where} has more bytes of {left[0]} than it should; it is damaged.")

    def _section(self, name: str, contexts: Contexts, *, count: int, alphabet: int) -> NDArray[np.uint8]:
        where = f"{self._where}, {name},"
        before = _last(self._tables, name, count, alphabet)
        self._tables[name] = decode_tables(self._taken(name, self.number(name, None)), before, where=where)
        size = section_bytes(self._left[name.partition(".")[0]], where=where)
        return decode(self._taken(name, size), contexts, self._tables[name], where=where)

    def _taken(self, name: str, size: int) -> memoryview:
        field = name.partition(".")[0]
        data = self._left.get(field, memoryview(b""))
        if size > len(data):
            raise StreamError(f"{self._where} ends {size - len(data)} bytes too early in {field}; it is damaged.")
        self._left[field] = data[size:]
        return data[:size]


SectionCoder = SectionEncoder | SectionDecoder


def _last(tables: Mapping[str, FrequencyTables], name: str, contexts: int, alphabet: int) -> FrequencyTables:
    """The tables of the last section of this name; initially geometric ones."""
    found = tables.get(name)
    return FrequencyTables(geometric_family(alphabet)[np.full(contexts, _FLAT)]) if found is None else found

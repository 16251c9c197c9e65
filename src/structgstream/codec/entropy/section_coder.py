# SPDX-License-Identifier: Apache-2.0
"""One description of what is coded, two directions.

Note [Two directions]
~~~~~~~~~~~~~~~~~~~~~
A format is written down once, as a function that hands values to a :class:`SectionCoder` and goes on with what it gets
back. An encoder is handed the true values and returns them; a decoder is handed None and returns what the bytes say. So
the two cannot disagree about order or contexts. Here are the sections of the init record; ``adaptive.py`` has packets.
"""

from collections.abc import Mapping
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from structgstream.codec.arrays import Bins, Contexts, Naturals
from structgstream.codec.entropy.bits import bit_lengths, fixed, pack_bits, unpack_numbers
from structgstream.codec.entropy.rans import decode, encode, section_bytes
from structgstream.codec.entropy.residual_symbols import ALPHABET, residuals_to_symbols, symbols_to_residuals
from structgstream.codec.entropy.table_choice import choose_tables
from structgstream.codec.entropy.table_sets import decode_tables
from structgstream.codec.entropy.tables import FrequencyTables, geometric_family
from structgstream.errors import StreamError
from structgstream.scene.state import FieldName

CLASSES = 32
"""Alphabet of the bit lengths of natural numbers below 2^31."""
_FLAT = 128  # of the geometric rows: what is expected of a context that has not been seen


class SectionCoder(Protocol):
    """Encodes or decodes arrays of whole numbers, one section after another; names tell whose tables are used."""

    def residuals(self, name: str, values: Bins | None, contexts: Contexts, *, count: int) -> Bins:
        """Small signed numbers ``[n]``: up to 7 costs its entropy, what is larger more."""
        ...

    def naturals(
        self, name: str, values: NDArray[np.int64] | None, contexts: Contexts, *, count: int
    ) -> NDArray[np.int64]:
        """Numbers ``[n]`` from 0 to below 2^31 of any size: the entropy of their bit length, and the bits below."""
        ...

    def number(self, name: str, value: int | None) -> int:
        """One number from 0 to below 2^32."""
        ...


class Tables:
    """The frequency tables that both sides hold, by name; what was not used yet is a geometric guess."""

    def __init__(self) -> None:
        self._sets: dict[str, FrequencyTables] = {}

    def get(self, name: str, *, contexts: int, alphabet: int) -> FrequencyTables:
        """The set of this name."""
        found = self._sets.get(name)
        if found is None:
            return FrequencyTables(geometric_family(alphabet)[np.full(contexts, _FLAT)])
        return found

    def put(self, name: str, tables: FrequencyTables) -> None:
        """What the set is from now on."""
        self._sets[name] = tables


class SectionEncoder:
    """Writes; what a name says before its dot is the field whose bytes in :attr:`fields` grow."""

    def __init__(self, tables: Tables) -> None:
        self._tables = tables
        self.fields: dict[str, bytes] = {}

    def residuals(self, name: str, values: Bins | None, contexts: Contexts, *, count: int) -> Bins:
        assert values is not None
        symbols, escapes = residuals_to_symbols(values)
        self._section(name, symbols, contexts, count=count, alphabet=ALPHABET)
        self._put(name, varint(len(escapes)) + escapes)
        return values

    def naturals(self, name: str, values: Naturals | None, contexts: Contexts, *, count: int) -> Naturals:
        assert values is not None
        if len(values) and not 0 <= int(values.min()) <= int(values.max()) < 2**31:
            raise StreamError("A number is beyond 31 bits; the step it was divided by is too small.")
        lengths = bit_lengths(values)
        self._section(name, lengths.astype(np.uint8), contexts, count=count, alphabet=CLASSES)
        rest = pack_bits(
            fixed(int(value) - (1 << int(size) - 1), int(size) - 1) for value, size in zip(values, lengths) if size > 1
        )
        self._put(name, rest)
        return values

    def number(self, name: str, value: int | None) -> int:
        assert value is not None
        self._put(name, varint(value))
        return value

    def _section(self, name: str, symbols: NDArray[np.uint8], contexts: Contexts, *, count: int, alphabet: int) -> None:
        before = self._tables.get(name, contexts=count, alphabet=alphabet)
        counts = np.zeros((count, alphabet), np.int64)
        np.add.at(counts, (contexts, symbols), 1)
        tables, packed = choose_tables(counts, before)
        self._tables.put(name, tables)
        self._put(name, varint(len(packed)) + packed + encode(symbols, contexts, tables))

    def _put(self, name: str, data: bytes) -> None:
        field = name.partition(".")[0]
        self.fields[field] = self.fields.get(field, b"") + data


class SectionDecoder:
    """Reads what :class:`SectionEncoder` wrote into the fields."""

    def __init__(self, tables: Tables, fields: Mapping[FieldName, bytes | memoryview], *, where: str) -> None:
        self._tables = tables
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
        """Nothing may be left.

        Raises:
            StreamError: something is.
        """
        if left := [name for name, data in self._left.items() if len(data)]:
            raise StreamError(f"{self._where} has more bytes of {left[0]} than it should; it is damaged.")

    def _section(self, name: str, contexts: Contexts, *, count: int, alphabet: int) -> NDArray[np.uint8]:
        where = f"{self._where}, {name},"
        before = self._tables.get(name, contexts=count, alphabet=alphabet)
        tables = decode_tables(self._taken(name, self.number(name, None)), before, where=where)
        self._tables.put(name, tables)
        size = section_bytes(self._left[name.partition(".")[0]], where=where)
        return decode(self._taken(name, size), contexts, tables, where=where)

    def _taken(self, name: str, size: int) -> memoryview:
        field = name.partition(".")[0]
        data = self._left.get(field, memoryview(b""))
        if size > len(data):
            raise StreamError(f"{self._where} ends {size - len(data)} bytes too early in {field}; it is damaged.")
        self._left[field] = data[size:]
        return data[:size]


def varint(value: int) -> bytes:
    """A number from 0 to below 2^32, seven bits a byte, the lowest first; all but the last have their highest bit."""
    out = bytearray()
    while value >= 128:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])

# SPDX-License-Identifier: Apache-2.0
"""Sections of symbols: interleaved rANS in C++ or NumPy, framing and bounds (docs/entropy.md, Symbols); and the coders
of the init record's sections.

Note [Two directions]
~~~~~~~~~~~~~~~~~~~~~
A format is described once, as a function that passes values to a :data:`SectionCoder` and continues with what it
returns. An encoder gets the true values and returns them; a decoder gets None and returns the decoded values. So both
directions use the same order and contexts. This module codes the init record, ``adaptive.py`` packets.
"""

import ctypes
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from structgstream.codec.entropy.bits import (
    Bins,
    Contexts,
    Naturals,
    bit_lengths,
    fixed,
    pack_bits,
    read_varint,
    unpack_numbers,
    unzigzag,
    varint,
    zigzag,
)
from structgstream.codec.entropy.tables import (
    COST_BITS,
    FREQUENCY_BITS,
    TOTAL,
    FrequencyTables,
    choose_tables,
    code_costs,
    decode_tables,
    geometric_family,
)
from structgstream.errors import OutOfMemoryError, StreamError
from structgstream.kernels.native import native_library, native_reason
from structgstream.scene.state import FieldName

LOW = 1 << 16
"""Lowest state, and the state before the first encoded symbol."""


def encode_lanes(
    symbols: NDArray[np.uint8], contexts: NDArray[np.uint16], tables: FrequencyTables, *, lanes: int
) -> tuple[NDArray[np.uint32], NDArray[np.uint16]]:
    """Final states u32 ``[lanes]`` and words u16 in the order of reading. Inputs have been checked."""
    frequencies = tables.rows[contexts, symbols].astype(np.uint64)
    starts = tables.starts[contexts, symbols].astype(np.uint64)
    states = np.full(lanes, LOW, np.uint64)
    pieces: list[NDArray[np.uint16]] = []
    for first in range((len(symbols) - 1) // lanes * lanes, -1, -lanes):
        f, c = frequencies[first : first + lanes], starts[first : first + lanes]
        x = states[: len(f)]
        full = x >= f << np.uint64(20)
        pieces.append((x[full] & np.uint64(0xFFFF)).astype(np.uint16))
        x = np.where(full, x >> np.uint64(16), x)
        states[: len(f)] = (x // f << np.uint64(FREQUENCY_BITS)) + x % f + c
    words = np.concatenate([*pieces[::-1], np.empty(0, np.uint16)])
    return states.astype(np.uint32), words


def decode_lanes(
    words: NDArray[np.uint16], states: NDArray[np.uint32], contexts: NDArray[np.uint16], tables: FrequencyTables
) -> NDArray[np.uint8] | None:
    """The symbols u8 ``[n]``, or None if states and words are inconsistent. Contexts have been checked."""
    lanes = len(states)
    used, rows = np.unique(contexts, return_inverse=True)
    slots = np.repeat(np.tile(np.arange(tables.alphabet, dtype=np.uint8), len(used)), tables.rows[used].reshape(-1))
    frequencies, starts = tables.rows[used].astype(np.uint64), tables.starts[used].astype(np.uint64)
    symbols = np.empty(len(contexts), np.uint8)
    x, position = states.astype(np.uint64), 0
    if (x < LOW).any():
        return None
    for first in range(0, len(contexts), lanes):
        row = rows[first : first + lanes]
        now = x[: len(row)]
        slot = now & np.uint64(TOTAL - 1)
        found = slots[row * TOTAL + slot.astype(np.int64)]
        symbols[first : first + lanes] = found
        now = frequencies[row, found] * (now >> np.uint64(FREQUENCY_BITS)) + slot - starts[row, found]
        low = np.flatnonzero(now < LOW)
        if position + len(low) > len(words):
            return None
        now[low] = now[low] << np.uint64(16) | words[position : position + len(low)]
        position += len(low)
        x[: len(row)] = now
    return symbols if position == len(words) and (x == LOW).all() else None


LANES = (1, 4, 32)
"""Number of lanes, by the code in a section's head."""

_NO_MEMORY, _DAMAGED = 1, 2  # results of the C++ coders
_LANE_BYTES = 3  # cost of a lane: half of its final state, and half of what is left of the other half
_MAX_SHARE = 512  # lanes cost at most a 512th of a section


def lanes_for(symbols: NDArray[np.uint8], contexts: NDArray[np.uint16], tables: FrequencyTables) -> int:
    """Number of lanes that the encoder takes: the most that cost at most a 512th of the symbols' bytes."""
    used = np.bincount(tables.rows[contexts, symbols], minlength=TOTAL + 1)
    size_bytes = int(used @ code_costs()) >> COST_BITS + 3
    return max(lanes for lanes in LANES if (lanes - 1) * _LANE_BYTES * _MAX_SHARE <= size_bytes)


def encode(
    symbols: NDArray[np.uint8],
    contexts: NDArray[np.uint16],
    tables: FrequencyTables,
    *,
    lanes: int | None = None,
    native: bool | None = None,
) -> bytes:
    """A section: numbers of symbols, words and lanes; states; words.

    Args:
        symbols: u8 ``[n]``, each below A and with a frequency of 1 or more in its context.
        contexts: u16 ``[n]``, each below C.
        lanes: 1, 4 or 32; None takes :func:`lanes_for`.
        native: C++ or NumPy, which give the same bytes; None takes C++ if available.
    """
    if not len(symbols):
        return varint(0)
    lanes = lanes_for(symbols, contexts, tables) if lanes is None else lanes
    code = _native_encode if uses_native(native) else encode_lanes
    states, words = code(symbols, contexts, tables, lanes=lanes)
    head = varint(len(symbols)) + varint(len(words) << 2 | LANES.index(lanes))
    return head + states.astype("<u4").tobytes() + words.astype("<u2").tobytes()


def decode(
    data: bytes | memoryview,
    contexts: NDArray[np.uint16],
    tables: FrequencyTables,
    *,
    where: str = "A section of symbols",
    native: bool | None = None,
) -> tuple[NDArray[np.uint8], int]:
    """The symbols u8 ``[n]`` of the section at the start of ``data``, with the contexts u16 ``[n]`` of its encoding,
    and where the section ends. Raises StreamError if it is damaged, or states another number of symbols."""
    count, start = read_varint(data, where=where)
    if count != len(contexts):
        raise StreamError(f"{where} states {count} symbols, {len(contexts)} are expected; it is damaged.")
    if not count:
        return np.empty(0, np.uint8), start
    value, start = read_varint(data, start, where=where)
    word_count, lane_code = value >> 2, value & 3
    # A symbol takes at most one word.
    if word_count > count or lane_code >= len(LANES):
        raise StreamError(f"{where} states {count} symbols in {word_count} words; it is damaged.")
    lanes = LANES[lane_code]
    end = start + 4 * lanes + 2 * word_count
    if end > len(data):
        raise StreamError(f"{where} states {end} bytes, {len(data)} are left; it is damaged.")
    states = np.frombuffer(data, "<u4", lanes, start).astype(np.uint32)
    words = np.frombuffer(data, "<u2", word_count, start + 4 * lanes).astype(np.uint16)
    code = _native_decode if uses_native(native) else decode_lanes
    if (symbols := code(words, states, contexts, tables)) is None:
        raise StreamError(f"{where} is damaged: its words and final states contradict each other.")
    return symbols, end


def uses_native(native: bool | None = None) -> bool:
    """Whether to use C++; None uses it if available."""
    return native_reason() is None if native is None else native


def code_native(name: str, *given: Any, doing: str) -> bool:
    """Calls a C++ coder, with arrays as their addresses; returns whether what it coded is sound. Raises
    OutOfMemoryError if there is not enough memory for ``doing``."""
    arguments = []
    for value in given:
        if isinstance(value, np.ndarray):
            assert value.flags.c_contiguous
            value = value.ctypes.data
        arguments.append(value)
    result = getattr(native_library(), name)(*arguments)
    if result == _NO_MEMORY:
        raise OutOfMemoryError(doing)
    assert result in (0, _DAMAGED), "what is coded fits its tables or models"
    return not result


def _native_encode(
    symbols: NDArray[np.uint8], contexts: NDArray[np.uint16], tables: FrequencyTables, *, lanes: int
) -> tuple[NDArray[np.uint32], NDArray[np.uint16]]:
    states, words, word_count = np.empty(lanes, np.uint32), np.empty(len(symbols), np.uint16), ctypes.c_int64()
    coded = (symbols, contexts, len(symbols), tables.rows, tables.contexts, tables.alphabet)
    written = (lanes, states, words, ctypes.byref(word_count))
    sound = code_native("sgs_rans_encode", *coded, *written, doing="to encode symbols")
    assert sound, "symbols, contexts and tables fit"
    return states, words[: word_count.value]


def _native_decode(
    words: NDArray[np.uint16], states: NDArray[np.uint32], contexts: NDArray[np.uint16], tables: FrequencyTables
) -> NDArray[np.uint8] | None:
    symbols = np.empty(len(contexts), np.uint8)
    read = (words, len(words), states, len(states), contexts, len(contexts))
    known = (tables.rows, tables.contexts, tables.alphabet)
    sound = code_native("sgs_rans_decode", *read, *known, symbols, doing="to decode symbols")
    return symbols if sound else None


LARGEST_SYMBOL = 7
ALPHABET = 16
"""Symbols of residuals: 0 to 14 for 0, -1, 1, -2, 2 ... -7, 7. The last one, for larger residuals, is not used."""
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
        """Signed numbers ``[n]`` from -7 to 7, entropy-coded, and the length of the larger ones' bytes, 0."""
        assert values is not None
        symbols = zigzag(values.astype(np.int64)).astype(np.uint8)
        self._section(name, symbols, contexts, count=count, alphabet=ALPHABET)
        self.number(name, 0)
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
        if self.number(name, None) or (symbols == ALPHABET - 1).any():
            raise StreamError(f"{self._where}, {name}, holds a residual beyond {LARGEST_SYMBOL}; it is damaged.")
        return unzigzag(symbols.astype(np.int64)).astype(np.int32)

    def naturals(self, name: str, values: Naturals | None, contexts: Contexts, *, count: int) -> Naturals:
        sizes = self._section(name, contexts, count=count, alphabet=CLASSES).astype(np.int64)
        widths = np.maximum(sizes - 1, 0)
        rest = unpack_numbers(self._taken(name, -(-int(widths.sum()) // 8)), widths, where=f"{self._where}, {name},")
        return np.where(sizes > 0, (1 << widths) + rest, 0)

    def number(self, name: str, value: int | None) -> int:
        found, end = read_varint(self._left_of(name), where=f"{self._where}, {name},")
        self._taken(name, end)
        return found

    def end(self) -> None:
        """Checks that all bytes have been read. Raises StreamError if some have not."""
        if left := [name for name, data in self._left.items() if len(data)]:
            raise StreamError(f"{self._where} has more bytes of {left[0]} than it should; it is damaged.")

    def _section(self, name: str, contexts: Contexts, *, count: int, alphabet: int) -> NDArray[np.uint8]:
        where = f"{self._where}, {name},"
        before = _last(self._tables, name, count, alphabet)
        self._tables[name] = decode_tables(self._taken(name, self.number(name, None)), before, where=where)
        symbols, end = decode(self._left_of(name), contexts, self._tables[name], where=where)
        self._taken(name, end)
        return symbols

    def _left_of(self, name: str) -> memoryview:
        return self._left.get(name.partition(".")[0], memoryview(b""))

    def _taken(self, name: str, size: int) -> memoryview:
        field, data = name.partition(".")[0], self._left_of(name)
        if size > len(data):
            raise StreamError(f"{self._where} ends {size - len(data)} bytes too early in {field}; it is damaged.")
        self._left[field] = data[size:]
        return data[:size]


SectionCoder = SectionEncoder | SectionDecoder


def _last(tables: Mapping[str, FrequencyTables], name: str, contexts: int, alphabet: int) -> FrequencyTables:
    """The tables of the last section of this name; initially geometric ones."""
    found = tables.get(name)
    return FrequencyTables(geometric_family(alphabet)[np.full(contexts, _FLAT)]) if found is None else found

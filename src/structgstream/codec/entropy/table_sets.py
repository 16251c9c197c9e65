# SPDX-License-Identifier: Apache-2.0
"""Decoding of table sets, relative to the previous ones (docs/entropy.md, Table sets).

Frequencies are coded as levels, floating-point numbers with ``p`` bits of mantissa: level 0 is frequency 0, level
``1 + e 2^p + r`` is ``(2^p + r) 2^e``. The precision ``p`` of a row depends on its number of symbols.
"""

import numpy as np
from numpy.typing import NDArray

from structgstream.codec.entropy.bits import BitReader
from structgstream.codec.entropy.tables import FREQUENCY_BITS, FrequencyTables, geometric_family, weighed
from structgstream.errors import StreamError

NUMBER_BITS = 8
PRECISION_BITS = 2
COUNT_BITS = 5
MOST_ZEROS = 8
_MOST_ROW_BYTES = 72  # 14 bits, 32 presence flags, and 32 levels of at most 17 bits


def levels_of(frequencies: NDArray[np.integer], *, precision: int) -> NDArray[np.int64]:
    """Levels, rounded down, of frequencies 0 to 4096; 0 gives level 1, because only present symbols' are coded."""
    f = np.maximum(frequencies.astype(np.int64), 1)
    exponent = np.frexp(f.astype(np.float64))[1].astype(np.int64) - 1  # exact for integers
    return 1 + (exponent << precision) + (f << precision >> exponent) - (1 << precision)


def weights_of(levels: NDArray[np.int64], *, precision: int) -> NDArray[np.int64]:
    """The frequencies of levels, in units of ``2^-precision``; 0 for level 0."""
    place = np.maximum(levels - 1, 0)
    mantissa = (1 << precision) + (place & (1 << precision) - 1)
    return np.where(levels > 0, mantissa << (place >> precision), 0)


def top_level(precision: int) -> int:
    """The highest level: just below twice 4096."""
    return (FREQUENCY_BITS + 1) << precision


def decode_tables(
    data: bytes | memoryview, previous: FrequencyTables, *, where: str = "A table set"
) -> FrequencyTables:
    """The tables coded in ``data`` relative to the previous ones, which have the same contexts and alphabet.

    Raises:
        StreamError: the set is damaged.
    """
    if len(data) > _MOST_ROW_BYTES * previous.contexts:
        raise StreamError(f"{where} has {len(data)} bytes for {previous.contexts} contexts; it is damaged.")
    if not len(data):
        return previous  # empty data: all rows stay
    reader = BitReader(data, where=where)
    family = geometric_family(previous.alphabet)
    rows = previous.rows.copy()
    for row in rows:
        if not reader.fixed(1):
            continue
        if not reader.fixed(1):
            row[:] = family[reader.fixed(NUMBER_BITS)]
            continue
        reference = family[reader.fixed(NUMBER_BITS)] if reader.fixed(1) else row
        row[:] = _explicit_row(reader, reference, where=where)
    reader.end()
    return FrequencyTables(rows)


def _explicit_row(reader: BitReader, reference: NDArray[np.uint16], *, where: str) -> NDArray[np.int64]:
    alphabet = len(reference)
    precision, order = reader.fixed(PRECISION_BITS), reader.fixed(1)
    if reader.fixed(1):
        present = [symbol for symbol in range(alphabet) if reader.fixed(1)]
    else:
        present = list(range(reader.fixed(COUNT_BITS) + 1))
    if not present or present[-1] >= alphabet:
        raise StreamError(f"{where} has a row without symbols, or with more than {alphabet}; it is damaged.")
    levels = np.zeros(alphabet, np.int64)
    levels[present] = levels_of(reference[present], precision=precision)
    for symbol in present if len(present) > 1 else ():
        levels[symbol] += reader.signed_golomb(order=order, most_zeros=MOST_ZEROS)
        if not 1 <= levels[symbol] <= top_level(precision):
            raise StreamError(f"{where} holds a frequency out of bounds; it is damaged.")
    return weighed(weights_of(levels, precision=precision))

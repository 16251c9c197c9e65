# SPDX-License-Identifier: Apache-2.0
"""Interleaved rANS in NumPy, all lanes at once: the oracle, used when the C++ is not built (docs/entropy.md)."""

import numpy as np
from numpy.typing import NDArray

from structgstream.codec.entropy.tables import FREQUENCY_BITS, TOTAL, FrequencyTables

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

# SPDX-License-Identifier: Apache-2.0
"""The oracle of interleaved rANS by numbers that are worked out here, step by step."""

import struct

import numpy as np
import pytest

from structgstream.codec.entropy.rans import LOW, decode, decode_lanes, encode, encode_lanes, has_native
from structgstream.codec.entropy.tables import FrequencyTables

# Symbol 0 three times as often as symbol 1: frequencies 3072 and 1024 of 4096, starts 0 and 3072.
TABLES = FrequencyTables(np.array([[3072, 1024]], np.uint16))


def encoded(symbols: list[int], lanes: int) -> tuple[np.ndarray, np.ndarray]:
    return encode_lanes(np.array(symbols, np.uint8), np.zeros(len(symbols), np.uint16), TABLES, lanes=lanes)


def test_one_symbol_by_hand() -> None:
    """``x // f * 4096 + x % f + start`` of the state 65536: 64 * 4096 + 0 + 3072, and 21 * 4096 + 1024."""
    assert [encoded([symbol], 1)[0].tolist() for symbol in (1, 0)] == [[265216], [87040]]
    assert not len(encoded([1], 1)[1])


def test_a_state_that_would_overflow_gives_a_word_first() -> None:
    """Fifteen rare symbols are 30 bits: state 2^16 grows by 2 bits each, until it is 2^30 (1024 << 20) or more."""
    x, words = LOW, []
    for _ in range(15):
        if x >= 1024 << 20:
            words.append(x & 0xFFFF)
            x >>= 16
        x = x // 1024 * 4096 + x % 1024 + 3072
    states, found = encoded([1] * 15, 1)
    assert states.tolist() == [x]
    assert found.tolist() == words[::-1]
    assert len(words) == 1


@pytest.mark.parametrize(
    "native", [False, pytest.param(True, marks=pytest.mark.skipif(not has_native(), reason="no C++"))]
)
def test_a_state_at_the_very_limit_gives_its_word(native: bool) -> None:
    """With a frequency of 2048 the state 2^16 doubles with every symbol and stands at its limit, 2^31, after 15."""
    halves = FrequencyTables(np.array([[2048, 2048]], np.uint16))
    symbols, contexts = np.zeros(16, np.uint8), np.zeros(16, np.uint16)
    states, words = encode_lanes(symbols, contexts, halves, lanes=1)
    assert (states.tolist(), words.tolist()) == ([LOW], [0])
    data = encode(symbols, contexts, halves, lanes=1, native=native)
    assert data.endswith(struct.pack("<IH", LOW, 0))
    assert not decode(data, contexts, halves, native=native).any()


def test_lanes_are_apart_but_for_their_words() -> None:
    """Symbol ``i`` belongs to lane ``i mod lanes``; lanes that were never used are as they began."""
    symbols = [1, 0, 0, 1, 1]
    states, words = encoded(symbols, 2)
    assert states.tolist() == [int(encoded(symbols[lane::2], 1)[0][0]) for lane in range(2)]
    assert encoded([1], 4)[0].tolist() == [265216, LOW, LOW, LOW]
    back = decode_lanes(words, states, np.zeros(5, np.uint16), TABLES)
    assert back is not None
    assert back.tolist() == symbols


@pytest.mark.parametrize("damage", ["word missing", "word too many", "other state", "state below the least"])
def test_states_and_words_that_contradict_each_other_are_none(damage: str) -> None:
    contexts = np.zeros(40, np.uint16)
    states, words = encoded([1] * 40, 2)
    if damage == "word missing":
        words = words[:-1]
    elif damage == "word too many":
        words = np.append(words, np.uint16(0))
    elif damage == "other state":
        states = states ^ np.array([0, 1 << 20], np.uint32)
    else:
        states = np.array([LOW - 1, states[1]], np.uint32)
    assert decode_lanes(words, states, contexts, TABLES) is None

# SPDX-License-Identifier: Apache-2.0
"""Table sets bit by bit, from the layout of docs/entropy.md: what each piece makes of the row before."""

import numpy as np
import pytest

from structgstream.codec.entropy.bits import fixed, pack_bits
from structgstream.codec.entropy.tables import (
    TOTAL,
    FrequencyTables,
    decode_tables,
    geometric,
    levels_of,
    top_level,
    weights_of,
)
from structgstream.errors import StreamError

EVEN = FrequencyTables(np.full((2, 4), TOTAL // 4, np.uint16))


def made(*pieces: str) -> list[list[int]]:
    return decode_tables(pack_bits([*pieces]), EVEN).rows.tolist()


def test_levels_by_hand() -> None:
    """Precision 1 has two numbers an octave: 1, 1.5, 2, 3, 4, 6, 8."""
    values = np.array([1, 2, 3, 4, 5, 6, 7, 8])
    assert levels_of(values, precision=1).tolist() == [1, 3, 4, 5, 5, 6, 6, 7]
    assert weights_of(np.arange(8), precision=1).tolist() == [0, 2, 3, 4, 6, 8, 12, 16]
    assert levels_of(np.array([0, 4096]), precision=0).tolist() == [1, 13]
    assert top_level(2) == 52


def test_no_bytes_keep_every_row() -> None:
    assert decode_tables(b"", EVEN) is EVEN


def test_a_row_is_kept_taken_from_the_family_or_told() -> None:
    """Kept: 0. Of the family: 10 and its number. Told: 11, whose reference, precision, order, and who is present."""
    family = geometric(np.array([77]), alphabet=4).rows[0].tolist()
    even = [TOTAL // 4] * 4
    assert made("0", "10" + fixed(77, 8)) == [even, family]
    only_third = "110" + fixed(0, 2) + "0" + "1" + "0010"
    assert made(only_third, "0") == [[0, 0, TOTAL, 0], even]
    first_two_as_before = "110" + fixed(0, 2) + "0" + "0" + fixed(1, 5) + "1" * 2
    assert made(first_two_as_before, "0") == [[TOTAL // 2, TOTAL // 2, 0, 0], even]


@pytest.mark.parametrize(
    ("pieces", "words"),
    [
        (["110" + fixed(0, 2) + "0" + "1" + "0000", "0"], "a row without symbols"),
        (["110" + fixed(0, 2) + "0" + "0" + fixed(4, 5), "0"], "or with more than 4"),
        (["0"] * 9, "damaged"),
        (["10"], "damaged"),
    ],
)
def test_sets_that_cannot_be_are_refused(pieces: list[str], words: str) -> None:
    with pytest.raises(StreamError, match=words):
        decode_tables(pack_bits(pieces), EVEN)


def test_more_bytes_than_rows_can_take_are_refused_before_they_are_read() -> None:
    with pytest.raises(StreamError, match="145 bytes for 2 contexts"):
        decode_tables(bytes(145), EVEN)

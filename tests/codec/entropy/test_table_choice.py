# SPDX-License-Identifier: Apache-2.0
"""Rows are sent where they pay for themselves, and only there."""

import numpy as np
import pytest

from structgstream.codec.entropy.table_choice import choose_tables
from structgstream.codec.entropy.tables import TOTAL, FrequencyTables, geometric, normalize_counts
from structgstream.errors import StreamError

EVEN = FrequencyTables(np.full((2, 4), TOTAL // 4, np.uint16))


def test_without_symbols_nothing_is_told() -> None:
    tables, bits = choose_tables(np.zeros((2, 4), int), EVEN)
    assert bits == b""
    assert (tables.rows == EVEN.rows).all()


def test_a_row_stays_where_a_new_one_saves_less_than_it_takes() -> None:
    """Four symbols of one kind take 8 bits with the even row, and no row is told in fewer than 10."""
    assert choose_tables(np.array([[4, 0, 0, 0], [0, 0, 0, 0]]), EVEN)[1] == b""
    tables, bits = choose_tables(np.array([[600, 0, 0, 0], [0, 0, 0, 0]]), EVEN)
    assert 0 < len(bits) <= 3
    assert tables.rows[0, 0] > 4000
    assert (tables.rows[1] == EVEN.rows[1]).all(), "the other context goes on"


def test_counts_of_the_family_choose_its_row() -> None:
    """Two bits say that it is of the family and eight which: whole bytes of head and row for two contexts."""
    family = geometric(np.array([60, 140]), alphabet=16)
    previous = FrequencyTables(np.full((2, 16), TOTAL // 16, np.uint16))
    tables, bits = choose_tables(family.rows.astype(int), previous)
    assert (tables.rows == family.rows).all()
    assert len(bits) == -(-2 * (2 + 8) // 8)


def test_choosing_again_for_the_same_counts_changes_nothing() -> None:
    counts = np.array([[900, 30, 5, 1], [10, 10, 400, 80]])
    tables, bits = choose_tables(counts, EVEN)
    assert bits
    again, more = choose_tables(counts, tables)
    assert more == b""
    assert (again.rows == tables.rows).all()
    assert choose_tables(counts, normalize_counts(counts))[1] == b"", "exact frequencies cannot be bettered"


@pytest.mark.parametrize("counts", [[[1, 2, 3]], [[1, 2, 3, -1], [0, 0, 0, 0]], [[1 << 30, 1 << 30, 0, 0], [0] * 4]])
def test_counts_that_do_not_fit_are_refused(counts: list[list[int]]) -> None:
    with pytest.raises(StreamError, match=r"must be of the tables' shape \(2, 4\)"):
        choose_tables(np.array(counts), EVEN)

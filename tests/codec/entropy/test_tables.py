# SPDX-License-Identifier: Apache-2.0
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from structgstream.codec.entropy.bits import fixed, pack_bits, signed_golomb
from structgstream.codec.entropy.tables import (
    TOTAL,
    FrequencyTables,
    choose_tables,
    code_costs,
    decode_tables,
    geometric_family,
    levels_of,
    logs,
    normalize_counts,
    top_level,
    weights_of,
)
from structgstream.errors import StreamError
from tests.support.properties import examples

COUNTS = st.lists(st.one_of(st.integers(0, 3), st.integers(0, 2**31)), min_size=1, max_size=32)


def bits_for(counts: np.ndarray, rows: np.ndarray) -> float:
    """Exact code length in bits."""
    with np.errstate(divide="ignore"):
        cost = np.where(counts > 0, -np.log2(rows / TOTAL), 0)
    return float((counts * cost).sum())


def laplace_counts(*, count: int, contexts: int, low: float, high: float, seed: int = 0) -> np.ndarray:
    g = np.random.default_rng(seed)
    context = g.integers(0, contexts, count)
    values = np.rint(g.laplace(0, np.linspace(low, high, contexts)[context])).astype(int)
    symbols = np.minimum(np.where(values >= 0, 2 * values, -2 * values - 1), 15)
    counts = np.zeros((contexts, 16), np.int64)
    np.add.at(counts, (context, symbols), 1)
    return counts


def geometric(*numbers: int) -> FrequencyTables:
    """These rows of the family for 16 symbols."""
    return FrequencyTables(geometric_family(16)[[*numbers]])


# Frequencies.


@given(COUNTS)
def test_what_occurs_has_a_frequency_and_a_row_sums_to_4096(counts: list[int]) -> None:
    row = normalize_counts(np.array([counts])).rows[0]
    assert row.sum() == TOTAL
    assert ((row > 0) == (np.array(counts) > 0)).all() or not any(counts)


def test_equals_are_served_from_the_first_on() -> None:
    assert normalize_counts(np.array([[7, 7, 7]])).rows.tolist() == [[1366, 1365, 1365]]
    assert normalize_counts(np.array([[0, 0, 0]])).rows.tolist() == [[1366, 1365, 1365]]
    assert normalize_counts(np.array([[1, 0, 10**9, 1, 10**9]])).rows.tolist() == [[1, 0, 2047, 1, 2047]]


def test_costs_are_logarithms() -> None:
    exact = np.log2(np.arange(1, 8192)) * 65536
    assert ((logs()[1:] <= exact + 1e-6) & (logs()[1:] > exact - 1.001)).all()
    assert code_costs()[[1, 2048, 4096]].tolist() == [12 << 16, 1 << 16, 0]


def test_the_default_family_is_that_of_the_document() -> None:
    """The example of docs/entropy.md: number 8 * 12 + 4."""
    assert geometric_family(5)[100].tolist() == [3644, 145, 145, 81, 81]
    rows = geometric_family(16).astype(int)
    assert (rows > 0).all()
    assert (np.diff(rows[:, 1::2], axis=1) <= 0).all()
    # The largest may have got the rest; all others come in equal pairs.
    pairs = rows[8 * 8 :]
    assert (pairs[:, 1:15:2] == pairs[:, 2:16:2]).all()
    zero = rows[::8, 0] / TOTAL
    assert zero[0] < 0.2
    assert zero[-1] > 0.995
    assert (np.diff(zero[8:]) >= 0).all()


@pytest.mark.parametrize("precision", range(4))
def test_levels_are_floating_point_numbers(precision: int) -> None:
    f = np.arange(1, TOTAL + 1)
    levels = levels_of(f, precision=precision)
    values = weights_of(levels, precision=precision) / 2**precision
    assert ((values <= f) & (values > f * (1 - 2.0**-precision) - 1e-9)).all()
    assert (levels.min(), weights_of(np.zeros(1, int), precision=precision)[0]) == (1, 0)
    assert levels.max() <= top_level(precision)
    every = np.arange(1, top_level(precision) + 1)
    assert (np.diff(weights_of(every, precision=precision)) > 0).all()


# Table sets.


@examples(80)
@given(st.data())
def test_chosen_tables_come_back_and_can_code_what_was_counted(data: st.DataObject) -> None:
    contexts, alphabet = data.draw(st.integers(1, 6)), data.draw(st.integers(2, 32))
    row = st.lists(
        st.one_of(st.just(0), st.integers(0, 5), st.integers(0, 10**6)), min_size=alphabet, max_size=alphabet
    )
    counts = np.array(data.draw(st.lists(row, min_size=contexts, max_size=contexts)))
    before = np.array(data.draw(st.lists(row, min_size=contexts, max_size=contexts)))
    previous = normalize_counts(before)
    tables, bits = choose_tables(counts, previous)
    assert (decode_tables(bits, previous).rows == tables.rows).all()
    assert (tables.rows[counts > 0] > 0).all()


@examples(40)
@given(st.integers(0, 2**31), st.integers(1, 5000))
def test_a_choice_is_never_longer_than_keeping_what_there_is(seed: int, count: int) -> None:
    counts = laplace_counts(count=count, contexts=8, low=0.2, high=2, seed=seed)
    previous = geometric(*[100] * 8)
    tables, bits = choose_tables(counts, previous)
    assert bits_for(counts, tables.rows) + 8 * len(bits) <= bits_for(counts, previous.rows) + 8 + 8


def test_tables_that_fit_are_kept_in_no_bytes() -> None:
    counts = laplace_counts(count=20_000, contexts=50, low=0.2, high=2)
    tables, _ = choose_tables(counts, geometric(*[100] * 50))
    again, bits = choose_tables(counts, tables)
    assert bits == b""
    assert (again.rows == tables.rows).all()
    assert (decode_tables(bytes(7), tables).rows == tables.rows).all(), "a bit each says the same"
    nothing, bits = choose_tables(np.zeros((50, 16), np.int64), tables)
    assert bits == b""
    assert (nothing.rows == tables.rows).all()


def test_precision_follows_the_number_of_symbols() -> None:
    shape = np.array([[700, 130, 90, 33, 57, 12, 15, 1, 0, 4, 0, 0, 0, 0, 0, 2]])
    previous = geometric(100)
    excess = []
    for times in (1, 10, 1000):
        tables, bits = choose_tables(shape * times, previous)
        excess.append((len(bits), bits_for(shape, tables.rows) / bits_for(shape, normalize_counts(shape).rows) - 1))
    (few, rough), (_, better), (many, fine) = excess
    assert few < many <= 16
    assert rough > better > fine
    assert fine < 1e-3


def row_bits(*, head: str = "110", precision: int = 1, order: int = 0, presence: str, steps: list[int]) -> bytes:
    text = head + fixed(precision, 2) + fixed(order, 1) + presence
    return pack_bits([text, *(signed_golomb(step, order=order) for step in steps)])


def test_the_rows_of_the_document() -> None:
    """The example of docs/entropy.md: a row with steps against the previous one."""
    previous = FrequencyTables(np.array([[3072, 512, 512, 0]], np.uint16))
    data = row_bits(presence="0" + fixed(2, 5), steps=[0, 1, -2])
    assert data.hex() == "c82b20"
    assert decode_tables(data, previous).rows.tolist() == [[3072, 768, 256, 0]]
    data = row_bits(presence="1" + "1001", steps=[0, 0])
    assert decode_tables(data, previous).rows.tolist() == [[4095, 0, 0, 1]]


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        (b"\x00\x00", "goes on"),
        (b"\x40", "goes on"),
        (bytes(400), "bytes for 1 contexts"),
        (b"\x80", "ends within"),
        (row_bits(presence="0" + fixed(4, 5), steps=[0] * 5), "more than 4"),
        (row_bits(presence="1" + "0000", steps=[]), "without symbols"),
        (row_bits(presence="0" + fixed(1, 5), steps=[4, 0]), "out of bounds"),
        (row_bits(presence="0" + fixed(1, 5), steps=[-24, 0]), "out of bounds"),
        (row_bits(presence="0" + fixed(1, 5), steps=[1 << 10, 0]), "cut or out of bounds"),
    ],
)
def test_a_damaged_set_is_refused(data: bytes, problem: str) -> None:
    with pytest.raises(StreamError, match=problem):
        decode_tables(data, FrequencyTables(np.array([[3072, 512, 512, 0]], np.uint16)))


@examples(200)
@given(st.binary(max_size=60))
def test_arbitrary_bytes_are_refused_or_are_tables(data: bytes) -> None:
    with suppress(StreamError):
        assert decode_tables(data, geometric(3, 100, 250)).contexts == 3

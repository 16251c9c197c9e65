# SPDX-License-Identifier: Apache-2.0
"""Both directions of one description (Note [Two directions])."""

import struct
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from structgstream.codec.entropy import rans
from structgstream.codec.entropy.bits import varint
from structgstream.codec.entropy.rans import (
    LANES,
    SectionDecoder,
    SectionEncoder,
    decode,
    encode,
    lanes_for,
    uses_native,
)
from structgstream.codec.entropy.tables import FrequencyTables, geometric_family, normalize_counts
from structgstream.errors import StreamError
from tests.support.properties import examples

NATIVE = [False, *([True] if uses_native() else [])]
both = pytest.mark.parametrize("native", NATIVE, ids=lambda native: "C++" if native else "NumPy")


def drawn(seed: int, *, count: int, contexts: int = 5, alphabet: int = 16, even: bool = False):
    """Symbols, contexts and tables in which all of the symbols that occur can be coded."""
    g = np.random.default_rng(seed)
    context = g.integers(0, contexts, count).astype(np.uint16)
    spread = np.linspace(0.3, 3.0, contexts)[context]
    symbol = g.integers(0, alphabet, count) if even else np.minimum(g.geometric(1 / (1 + spread)) - 1, alphabet - 1)
    counts = np.zeros((contexts, alphabet), np.int64)
    np.add.at(counts, (context, symbol), 1)
    return symbol.astype(np.uint8), context, normalize_counts(counts)


@both
@examples(60)
@given(
    seed=st.integers(0, 2**31),
    count=st.integers(0, 200),
    contexts=st.integers(1, 40),
    alphabet=st.integers(1, 32),
    lanes=st.sampled_from(LANES),
    even=st.booleans(),
)
def test_symbols_come_back(native, seed, count, contexts, alphabet, lanes, even) -> None:
    symbols, context, tables = drawn(seed, count=count, contexts=contexts, alphabet=alphabet, even=even)
    data = encode(symbols, context, tables, lanes=lanes, native=native)
    found, end = decode(data + b"more", context, tables, native=native)
    assert (found == symbols).all()
    assert end == len(data)


@both
@examples(60)
@given(st.data())
def test_any_table_codes_what_it_has_a_frequency_for(native, data: st.DataObject) -> None:
    weights = data.draw(st.lists(st.integers(0, 2**20), min_size=1, max_size=32).filter(any))
    tables = normalize_counts(np.array([weights]))
    possible = np.flatnonzero(tables.rows[0]).tolist()
    symbols = np.array(data.draw(st.lists(st.sampled_from(possible), max_size=80)), np.uint8)
    context = np.zeros(len(symbols), np.uint16)
    found, _ = decode(encode(symbols, context, tables, native=native), context, tables, native=native)
    assert (found == symbols).all()


@pytest.mark.skipif(not uses_native(), reason="the native library has no entropy coder")
@pytest.mark.parametrize("count", [1, 31, 33, 999, 5000])
@pytest.mark.parametrize("lanes", LANES)
def test_both_coders_write_the_same_bytes_and_read_each_other(count: int, lanes: int) -> None:
    symbols, context, tables = drawn(count, count=count, contexts=50)
    data = encode(symbols, context, tables, lanes=lanes, native=True)
    assert data == encode(symbols, context, tables, lanes=lanes, native=False)
    one, other = (decode(data, context, tables, native=native)[0] for native in (True, False))
    assert (one == other).all()


@both
def test_the_bytes_are_those_of_the_document(native) -> None:
    """The example of docs/entropy.md, worked by hand there."""
    tables = FrequencyTables(np.array([[3072, 1024], [3, 4093]], np.uint16))
    symbols, context = np.array([0, 1, 0, 0], np.uint8), np.array([0, 0, 1, 1], np.uint16)
    data = encode(symbols, context, tables, native=native)
    assert data == bytes.fromhex("04 04  00 B8 97 00  01 50")
    assert decode(data, context, tables, native=native)[0].tolist() == [0, 1, 0, 0]


def test_a_certain_symbol_costs_nothing() -> None:
    tables = FrequencyTables(np.array([[0, 4096]], np.uint16))
    assert len(encode(np.ones(5000, np.uint8), np.zeros(5000, np.uint16), tables)) == 2 + 1 + 4


def test_no_symbols_are_one_byte() -> None:
    nothing = np.empty(0, np.uint8), np.empty(0, np.uint16), FrequencyTables(np.array([[4096]], np.uint16))
    assert encode(*nothing) == b"\0"
    assert len(decode(b"\0", *nothing[1:])[0]) == 0


def test_a_section_takes_more_lanes_as_it_grows() -> None:
    sizes = {count: lanes_for(*drawn(0, count=count, even=True)) for count in (100, 9000, 9500, 94_000, 96_000)}
    assert sizes == {100: 1, 9000: 1, 9500: 4, 94_000: 4, 96_000: 32}


# What is damaged.


@both
def test_every_cut_is_refused(native) -> None:
    symbols, context, tables = drawn(5, count=100)
    data = encode(symbols, context, tables)
    for end in range(len(data)):
        with pytest.raises(StreamError, match=r"damaged|cut"):
            decode(data[:end], context, tables, native=native)


@both
@examples(150)
@given(
    count=st.integers(1, 80),
    lanes=st.sampled_from(range(3)),
    states=st.binary(min_size=128, max_size=128),
    data=st.data(),
)
def test_arbitrary_states_and_words_never_do_harm(native, count: int, lanes: int, states: bytes, data) -> None:
    word_count = data.draw(st.integers(0, min(count, 31)))
    words = data.draw(st.binary(min_size=2 * word_count, max_size=2 * word_count))
    _, context, tables = drawn(count, count=count)
    section = bytes([count, word_count << 2 | lanes]) + states[: 4 * LANES[lanes]] + words
    with suppress(StreamError):
        found, end = decode(section, context, tables, native=native)
        assert (found.shape, end) == ((count,), len(section))


@both
@examples(150)
@given(st.binary(max_size=60))
def test_arbitrary_bytes_are_refused_or_decode(native, data: bytes) -> None:
    _, context, tables = drawn(6, count=20)
    for count in {0, 1, 20, min(data[0], 20) if data else 0}:
        with suppress(StreamError):
            assert len(decode(data, context[:count], tables, native=native)[0]) == count


@pytest.mark.parametrize(
    ("head", "problem"),
    [
        (b"\xff\xff\xff\xff\xff", "cut or beyond 32 bits"),
        (b"\xff\xff\xff\xff\x0f\x00", "damaged"),  # 2^32 - 1 symbols
        (b"\x14\xfc\xff\xff\xff\x0f", "damaged"),  # more words than symbols
        (b"\x14\x03", "damaged"),  # the lane code that means nothing
        (b"\x15\x00", "states 21 symbols, 20 are expected"),
        (b"\x00", "states 0 symbols"),
        (b"\x14\x00" + struct.pack("<I", 0xFFFF), "contradict"),  # a state below 2^16
    ],
)
def test_what_a_head_states_is_checked_first(head: bytes, problem: str) -> None:
    _, context, tables = drawn(6, count=20)
    with pytest.raises(StreamError, match=problem):
        decode(head, context, tables)


@both
def test_states_that_do_not_come_home_are_refused(native) -> None:
    tables = FrequencyTables(np.array([[4096]], np.uint16))
    context = np.zeros(20, np.uint16)
    assert decode(b"\x14\x00" + struct.pack("<I", 1 << 16), context, tables, native=native)[0].tolist() == [0] * 20
    with pytest.raises(StreamError, match="contradict"):
        decode(b"\x14\x00" + struct.pack("<I", (1 << 16) + 1), context, tables, native=native)


def test_without_the_native_library_numpy_does_it(monkeypatch: pytest.MonkeyPatch) -> None:
    symbols, context, tables = drawn(1, count=200)
    data = encode(symbols, context, tables)
    monkeypatch.setattr(rans, "native_reason", lambda: "none")
    assert encode(symbols, context, tables) == data
    assert (decode(data, context, tables)[0] == symbols).all()


NATURAL = st.one_of(st.integers(0, 20), st.integers(0, 2**31 - 1), st.sampled_from([2**30 - 1, 2**30, 2**31 - 1]))
RESIDUAL = st.integers(-7, 7)


def contexts_for(values: list, count: int) -> np.ndarray:
    return (np.arange(len(values)) * 7 % count).astype(np.uint16)


def reader(fields: dict[str, bytes]) -> SectionDecoder:
    return SectionDecoder(fields, where="Packet 0")  # type: ignore[arg-type]


@examples(100)
@given(st.lists(NATURAL, max_size=30), st.lists(RESIDUAL, max_size=30))
def test_what_is_written_is_read(naturals: list[int], residuals: list[int]) -> None:
    writer, n = SectionEncoder(), np.array(naturals, np.int64)
    r = np.array(residuals, np.int32)
    writer.naturals("one.size", n, contexts_for(naturals, 3), count=3)
    writer.number("one.count", 2**32 - 1)
    writer.residuals("two.step", r, contexts_for(residuals, 5), count=5)
    writer.naturals("one.size", n, contexts_for(naturals, 3), count=3)  # with the tables of the first time
    assert writer.fields.keys() == {"one", "two"}
    back = reader(writer.fields)
    assert back.naturals("one.size", None, contexts_for(naturals, 3), count=3).tolist() == naturals
    assert back.number("one.count", None) == 2**32 - 1
    assert back.residuals("two.step", None, contexts_for(residuals, 5), count=5).tolist() == residuals
    assert back.naturals("one.size", None, contexts_for(naturals, 3), count=3).tolist() == naturals
    back.end()


def test_what_is_left_over_is_reported() -> None:
    writer = SectionEncoder()
    writer.number("one.count", 5)
    with pytest.raises(StreamError, match="Packet 0 has more bytes of one than it should"):
        reader(writer.fields).end()


def test_residuals_that_have_no_symbol_are_refused() -> None:
    """An escape, which the format once foresaw, and bytes of one (docs/bitstream.md, Coded init fields)."""
    table = b"\x02\xb7\x80"  # symbols of context 0 by row 222 of the family
    for symbol, more in ((15, 0), (14, 1)):
        tables = FrequencyTables(geometric_family(16)[[222]])
        section = encode(np.array([symbol], np.uint8), np.zeros(1, np.uint16), tables)
        data = table + section + varint(more)
        with pytest.raises(StreamError, match=r"Packet 0, one\.step, holds a residual beyond 7"):
            reader({"one": data}).residuals("one.step", None, np.zeros(1, np.uint16), count=1)


@pytest.mark.parametrize("value", [-1, 2**31])
def test_a_natural_number_out_of_range(value: int) -> None:
    with pytest.raises(StreamError, match="beyond 31 bits"):
        SectionEncoder().naturals("one.size", np.array([value]), np.zeros(1, np.uint16), count=1)


def test_tables_persist() -> None:
    encoder, values = SectionEncoder(), np.array([5, 5, 5, -5] * 40, np.int32)
    nothing = np.zeros(len(values), np.uint16)
    encoder.residuals("one.step", values, nothing, count=1)
    first = len(encoder.fields["one"])
    encoder.residuals("one.step", values, nothing, count=1)
    assert len(encoder.fields["one"]) < 2 * first, "the table is known by then"

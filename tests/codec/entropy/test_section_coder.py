# SPDX-License-Identifier: Apache-2.0
"""Both directions of one description (Note [Two directions])."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from structgstream.codec.entropy.bits import fixed, pack_bits, unpack_numbers, varint
from structgstream.codec.entropy.rans import SectionDecoder, SectionEncoder
from structgstream.errors import StreamError
from tests.support.properties import examples

NATURAL = st.one_of(st.integers(0, 20), st.integers(0, 2**31 - 1), st.sampled_from([2**30 - 1, 2**30, 2**31 - 1]))
RESIDUAL = st.one_of(st.integers(-9, 9), st.integers(-(2**31), 2**31 - 1))


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


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"\xff\xff\xff\xff\x10", "beyond 32 bits"),
        (b"\x80\x80\x80\x80\x80\x01", "beyond 32 bits"),
        (b"\x80", "ends 1 bytes too early in one"),
        (b"", "ends 1 bytes too early in one"),
    ],
)
def test_a_number_that_is_none(data: bytes, message: str) -> None:
    with pytest.raises(StreamError, match=message):
        reader({"one": data}).number("one.count", None)


def test_numbers_have_seven_bits_a_byte() -> None:
    assert [varint(n) for n in (0, 127, 128, 2**32 - 1)] == [b"\0", b"\x7f", b"\x80\x01", b"\xff\xff\xff\xff\x0f"]
    for n in (0, 1, 127, 128, 300, 2**28 - 1, 2**28, 2**32 - 1):
        assert reader({"one": varint(n)}).number("one.count", None) == n


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


@examples(100)
@given(st.lists(st.tuples(st.integers(0, 56), st.integers(0, 2**56 - 1)), max_size=40))
def test_numbers_are_found_at_any_bit(pairs: list[tuple[int, int]]) -> None:
    values = [value % (1 << width) for width, value in pairs]
    widths = np.array([width for width, _ in pairs], np.int64)
    data = pack_bits(fixed(value, width) for value, (width, _) in zip(values, pairs) if width)
    assert unpack_numbers(data, widths, where="").tolist() == values
    with pytest.raises(StreamError, match="It has .* bytes for .* bits of numbers"):
        unpack_numbers(data + b"\0", widths, where="It")


def test_what_stands_behind_the_last_number_must_be_zero() -> None:
    """Every file that says the same is the same."""
    assert unpack_numbers(b"\xa0", np.array([3]), where="").tolist() == [5]
    for data in (b"\xa1", b"\xb0", b""):
        with pytest.raises(StreamError, match="damaged"):
            unpack_numbers(data, np.array([3]), where="It")

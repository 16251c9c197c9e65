# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from structgstream.codec.entropy.bits import (
    BitReader,
    bit_lengths,
    fixed,
    pack_bits,
    read_varint,
    signed_golomb,
    unpack_numbers,
    unzigzag,
    varint,
    zigzag,
)
from structgstream.errors import StreamError

WHERE = "It"


@given(st.lists(st.tuples(st.integers(-5000, 5000), st.integers(0, 3))))
def test_golomb_codes_come_back(pieces: list[tuple[int, int]]) -> None:
    data = pack_bits(signed_golomb(value, order=order) for value, order in pieces)
    reader = BitReader(data, where=WHERE)
    assert [reader.signed_golomb(order=order, max_zeros=14) for _, order in pieces] == [value for value, _ in pieces]
    reader.end()


def test_the_codes_of_the_document() -> None:
    """docs/entropy.md, section Bits."""
    codes = [signed_golomb(unzigzag(value), order=2) for value in (0, 3, 4, 5, 12)]
    assert codes == ["100", "111", "01000", "01001", "0010000"]
    values = [0, -1, 1, -2, 2, 2**62 - 1, -(2**62)]
    assert [zigzag(value) for value in values] == [0, 1, 2, 3, 4, 2**63 - 2, 2**63 - 1]
    assert [unzigzag(zigzag(value)) for value in values] == values
    assert zigzag(np.array(values)).tolist() == [zigzag(value) for value in values]
    assert unzigzag(zigzag(np.array(values))).tolist() == values


def test_more_zeros_than_allowed_and_a_cut() -> None:
    data = pack_bits([signed_golomb(6, order=0)])  # 0001101
    assert BitReader(data, where=WHERE).signed_golomb(order=0, max_zeros=3) == 6
    with pytest.raises(StreamError, match="It holds a number that is cut or out of bounds"):
        BitReader(data, where=WHERE).signed_golomb(order=0, max_zeros=2)
    with pytest.raises(StreamError, match="It ends within a number"):
        BitReader(b"\x01", where=WHERE).signed_golomb(order=0, max_zeros=7)
    with pytest.raises(StreamError, match="It ends within a number"):
        BitReader(b"\x01", where=WHERE).fixed(9)


@pytest.mark.parametrize(("data", "fits"), [(b"\xe0", True), (b"\xe1", False), (b"\xe0\x00", False), (b"\xf0", False)])
def test_only_zeros_fill_the_last_byte(data: bytes, fits: bool) -> None:
    reader = BitReader(data, where=WHERE)
    assert reader.fixed(3) == 7
    widths = np.array([3])
    if fits:
        reader.end()
        assert unpack_numbers(data, widths, where=WHERE).tolist() == [7]
        return
    with pytest.raises(StreamError, match="It goes on after its last number"):
        reader.end()
    with pytest.raises(StreamError, match="bytes for 3 bits of numbers"):
        unpack_numbers(data, widths, where=WHERE)


SIZED = st.integers(0, 56).flatmap(lambda width: st.tuples(st.just(width), st.integers(0, 2**width - 1)))


@given(st.lists(SIZED))
def test_numbers_of_many_widths(pieces: list[tuple[int, int]]) -> None:
    data = pack_bits(fixed(value, width) for width, value in pieces if width)
    widths = np.array([width for width, _ in pieces], np.int64)
    assert unpack_numbers(data, widths, where=WHERE).tolist() == [value for _, value in pieces]


def test_numbers_have_seven_bits_a_byte() -> None:
    assert [varint(n) for n in (0, 127, 128, 2**32 - 1)] == [b"\0", b"\x7f", b"\x80\x01", b"\xff\xff\xff\xff\x0f"]
    for n in (0, 1, 127, 128, 300, 2**28 - 1, 2**28, 2**32 - 1):
        data = b"x" + varint(n)
        assert read_varint(data + b"more", 1, where=WHERE) == (n, len(data))
    for data in (b"\xff\xff\xff\xff\x10", b"\x80\x80\x80\x80\x80\x01", b"\x80", b""):
        with pytest.raises(StreamError, match="It holds a number that is cut or beyond 32 bits"):
            read_varint(data, where=WHERE)


def test_bit_lengths_are_exact() -> None:
    values = [0, 1, 2, 3, 4, 2**30 - 1, 2**30, 2**31 - 1]
    assert bit_lengths(np.array(values, np.int64)).tolist() == [v.bit_length() for v in values]

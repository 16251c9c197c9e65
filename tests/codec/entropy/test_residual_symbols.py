# SPDX-License-Identifier: Apache-2.0
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from structgstream.codec.entropy.bits import (
    BitReader,
    fixed,
    golomb,
    pack_bits,
    residuals_to_symbols,
    signed_golomb,
    symbols_to_residuals,
)
from structgstream.errors import StreamError

INT32 = st.one_of(st.integers(-9, 9), st.integers(-(2**31), 2**31 - 1), st.sampled_from([-(2**31), 2**31 - 1]))


@given(st.lists(INT32, max_size=60))
def test_residuals_come_back(values: list[int]) -> None:
    symbols, escapes = residuals_to_symbols(np.array(values, np.int64))
    assert symbols.dtype == np.uint8
    assert symbols_to_residuals(symbols, escapes).tolist() == values
    assert symbols_to_residuals(symbols, escapes).dtype == np.int32


def test_the_order_of_symbols_is_that_of_the_document() -> None:
    symbols, escapes = residuals_to_symbols(np.array([0, -1, 1, -2, 2, -7, 7, 8, -8, -2, 13], np.int32))
    assert symbols.tolist() == [0, 1, 2, 3, 4, 13, 14, 15, 15, 3, 15]
    # 8: 100 0; -8: 100 1; 13 is 5 more than 8: 0 1001 0.
    assert escapes == bytes([0b10001001, 0b01001000])


def test_small_residuals_need_no_escapes() -> None:
    assert residuals_to_symbols(np.arange(-7, 8))[1] == b""
    assert residuals_to_symbols(np.empty(0, np.int32))[0].shape == (0,)


@pytest.mark.parametrize("value", [2**31, -(2**31) - 1, 2**40])
def test_a_residual_beyond_32_bits_is_refused(value: int) -> None:
    with pytest.raises(StreamError, match="beyond 32 bits"):
        residuals_to_symbols(np.array([0, value]))


def escaped(magnitude: int, *, negative: bool) -> bytes:
    return pack_bits([golomb(magnitude - 8, order=2), fixed(negative, 1)])


@pytest.mark.parametrize(
    ("symbols", "escapes", "problem"),
    [
        ([16], b"", "above 15"),
        ([15], b"", "0 bytes for 1 values"),
        ([1], b"\x80", "1 bytes for 0 values"),
        ([15], bytes(9), "9 bytes for 1 values"),
        ([15], bytes(4), "cut or out of bounds"),
        ([15], bytes(8), "cut or out of bounds"),
        ([15], b"\x01", "ends within"),
        ([15], b"\x80\x00", "goes on"),
        ([15], b"\x84", "goes on"),
        ([15], escaped(2**31, negative=False), "beyond 32 bits"),
        ([15], escaped(2**31 + 1, negative=True), "beyond 32 bits"),
    ],
)
def test_damaged_escapes_are_refused(symbols: list[int], escapes: bytes, problem: str) -> None:
    with pytest.raises(StreamError, match=problem):
        symbols_to_residuals(np.array(symbols, np.uint8), escapes)


@given(st.integers(0, 20), st.binary(max_size=40))
def test_arbitrary_bytes_are_refused_or_are_residuals(count: int, data: bytes) -> None:
    with suppress(StreamError):
        assert (np.abs(symbols_to_residuals(np.full(count, 15, np.uint8), data).astype(np.int64)) >= 8).all()


@given(st.lists(st.tuples(st.integers(-(2**20), 2**20), st.integers(0, 3)), max_size=20))
def test_bits_come_back(values: list[tuple[int, int]]) -> None:
    data = pack_bits(signed_golomb(value, order=order) for value, order in values)
    reader = BitReader(data, where="It")
    assert [reader.signed_golomb(order=order, max_zeros=22) for _, order in values] == [value for value, _ in values]
    reader.end()

# SPDX-License-Identifier: Apache-2.0
"""Adaptive decisions: C++ against Python, and what the arithmetic code promises."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from structgstream.codec.entropy import decisions as reference
from structgstream.codec.entropy.decisions import (
    ACTIVITY_CONTEXTS,
    BLOCK_CONTEXTS,
    NUMBER_NODES,
    ArithmeticState,
    Model,
    code_activity,
    code_numbers,
    code_residuals,
    residual_contexts,
)
from structgstream.codec.entropy.rans import uses_native
from tests.support.properties import examples

NATIVE = [False, *([True] if uses_native() else [])]
both = pytest.mark.parametrize("native", NATIVE)
NUMBER = st.one_of(st.integers(-9, 9), st.integers(-(2**31) + 1, 2**31 - 1))


def coded_numbers(values: list[int], *, native: bool, flags: bool = False) -> tuple[bytes, Model]:
    model, code = Model.new([2, 3, 1], nodes=1 if flags else NUMBER_NODES), ArithmeticState(None)
    given = np.array(values, np.int64)
    assert code_numbers(code, model, contexts=contexts_for(values), values=given, flags=flags, native=native)
    return code.finished(), model


def decoded_numbers(
    data: bytes, count: int, *, native: bool, flags: bool = False
) -> tuple[list[int] | None, ArithmeticState]:
    """The numbers, None if one is out of bounds, and the code after them."""
    model, code = Model.new([2, 3, 1], nodes=1 if flags else NUMBER_NODES), ArithmeticState(data)
    found = np.zeros(count, np.int64)
    sound = code_numbers(code, model, contexts=contexts_for([0] * count), values=found, flags=flags, native=native)
    return found.tolist() if sound else None, code


def contexts_for(values: list[int]) -> np.ndarray:
    places = np.arange(len(values), dtype=np.int32)
    return np.stack([places % 2, places % 3, 0 * places], axis=1)


@pytest.mark.skipif(not uses_native(), reason="the native library has no entropy coder")
@examples(60)
@given(st.lists(NUMBER, max_size=40), st.booleans())
def test_both_give_the_same_bytes_and_models(values: list[int], flags: bool) -> None:
    values = [value & 1 for value in values] if flags else values
    (one, mine), (two, its) = (coded_numbers(values, native=native, flags=flags) for native in (False, True))
    assert one == two
    for name in ("chances", "seen", "weights"):
        assert (getattr(mine, name) == getattr(its, name)).all()
    for native in NATIVE:
        found, code = decoded_numbers(one, len(values), native=native, flags=flags)
        assert found == values
        assert code.is_exhausted() or not values
        assert not code.is_overrun()


@pytest.mark.skipif(not uses_native(), reason="the native library has no entropy coder")
@examples(25)
@given(st.integers(0, 2**32 - 1), st.integers(0, 150))
def test_rows_are_the_same_in_both(seed: int, rows: int) -> None:
    g = np.random.default_rng(seed)
    active = (g.random(rows) < g.choice([0.02, 0.3, 0.9])).astype(np.uint8)
    history = g.integers(0, 8, rows).astype(np.uint8)
    sizes = g.integers(0, 40, rows).astype(np.int32)
    values, last = (np.rint(g.laplace(0, g.choice([0.5, 9, 1e5]), (rows, 3))).astype(np.int32) for _ in range(2))
    found = []
    for native in NATIVE:
        code, back, residuals = ArithmeticState(None), active.copy(), values.copy()
        for decodes in (False, True):
            blocks, its_rows = Model.new(BLOCK_CONTEXTS, nodes=1), Model.new(ACTIVITY_CONTEXTS, nodes=1)
            model = Model.new(residual_contexts(3), nodes=NUMBER_NODES)
            code_activity(code, (blocks, its_rows), history=history, sizes=sizes, active=back, native=native)
            assert code_residuals(code, model, last=last, others=sizes, residuals=residuals, native=native)
            if not decodes:
                data = code.finished()
                found.append([data, blocks.chances.tolist(), its_rows.weights.tolist(), model.chances.tolist()])
                code, back, residuals = ArithmeticState(data), 0 * active, 0 * values
        assert code.is_exhausted() or not rows
        assert (back == active).all()
        assert (residuals == values).all()
    assert found[0] == found[-1]


@both
def test_the_example_of_the_document(native: bool) -> None:
    model, code = Model.new([2], nodes=NUMBER_NODES), ArithmeticState(None)
    values, contexts = np.array([0, 3, -1, 20, 0]), np.array([[0], [0], [1], [1], [0]], np.int32)
    code_numbers(code, model, contexts=contexts, values=values, native=native)
    assert code.finished().hex(" ") == "92 a5 ec 05"


@both
def test_what_is_certain_takes_next_to_nothing_and_what_is_not_a_bit(native: bool) -> None:
    assert len(coded_numbers([0] * 10_000, native=native, flags=True)[0]) < 8
    coins = np.random.default_rng(2).integers(0, 2, 8000).tolist()
    assert 1000 < len(coded_numbers(coins, native=native, flags=True)[0]) < 1030


@both
def test_carries_run_through_many_bytes(native: bool) -> None:
    """Likely decisions first and unlikely ones then push the code to the upper end of its range."""
    for seed in range(30):
        g = np.random.default_rng(seed)
        values = [*([1] * 400), *g.integers(0, 2, 5).tolist(), *([0] * int(g.integers(1, 60)))]
        data, _ = coded_numbers(values, native=native, flags=True)
        assert decoded_numbers(data, len(values), native=native, flags=True)[0] == values


@both
def test_a_code_that_is_cut_or_goes_on_is_not_whole(native: bool) -> None:
    values = np.random.default_rng(3).integers(-5, 6, 60).tolist()
    data, _ = coded_numbers(values, native=native)
    for other in (data + b"\0", data[:-2], b""):
        found, code = decoded_numbers(other, 60, native=native)
        assert not code.is_exhausted() or found != values
    assert ArithmeticState(b"").is_exhausted()
    assert not ArithmeticState(b"\0").is_exhausted()


@both
def test_any_bytes_are_numbers_or_damage(native: bool) -> None:
    """Bits that always say yes make the largest number there is, which is refused."""
    g = np.random.default_rng(4)
    for data in (b"", bytes(40), b"\xff" * 40, *(g.bytes(30) for _ in range(50))):
        found, _ = decoded_numbers(data, 50, native=native)
        assert all(abs(number) < 2**31 for number in found or ())


def test_squash_and_stretch_belong_together() -> None:
    chances = [reference.squashed(logit) for logit in range(-reference.FAR, reference.FAR + 1)]
    assert chances == sorted(chances)
    assert (chances[0], chances[reference.FAR], chances[-1]) == (32, 32768, 65504)
    logits = reference.stretched()
    assert logits == sorted(logits)
    for i in range(4096):
        assert abs(reference.squashed(logits[i]) - 16 * i - 8) <= 70 or i in (0, 1, 4094, 4095)

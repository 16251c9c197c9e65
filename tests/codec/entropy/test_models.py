# SPDX-License-Identifier: Apache-2.0
"""What is expected before anything was seen, the end of an arithmetic code, and carries."""

import pytest

from structgstream.codec.entropy.models import AHEAD, HALF, ArithmeticState, Model, Models, carry, residual_contexts


def test_a_new_model_expects_nothing() -> None:
    model = Model.new((2, 3, 1), nodes=4)
    assert model.chances.shape == model.seen.shape == (6, 4)
    assert (model.chances == HALF).all()
    assert not model.seen.any()
    assert model.weights.tolist() == [[65536 // 3] * 3] * 4
    assert model.starts.tolist() == [0, 2, 5]
    assert model.nodes == 4


def test_contexts_of_residuals_by_columns() -> None:
    """The products of docs/entropy.md."""
    assert residual_contexts(1) == (17, 81, 155, 60, 96, 343)
    assert residual_contexts(3) == (51, 81, 155, 180, 288, 343)


def test_models_go_on_from_those_before_without_changing_them() -> None:
    first = Models()
    first.get("a", (2,), nodes=1).chances[0] = 9
    second = Models(first)
    assert second.all()["a"] is first.all()["a"], "nothing is copied until it is asked for"
    mine = second.get("a", (2,), nodes=1)
    mine.chances[0], mine.weights[0] = 7, 1
    assert second.get("a", (2,), nodes=1) is mine
    assert first.get("a", (2,), nodes=1).chances[0, 0] == 9
    assert first.get("a", (2,), nodes=1).weights[0, 0] == 65536
    second.get("b", (1,), nodes=1)
    assert (set(first.all()), set(second.all())) == ({"a"}, {"a", "b"})


@pytest.mark.parametrize(
    ("before", "end", "after"),
    [
        ("01 02", 2, "01 03"),
        ("01 ff ff", 3, "02 00 00"),
        ("01 ff 05", 2, "02 00 05"),
        ("00 ff ff 10", 3, "01 00 00 10"),
    ],
)
def test_one_more_runs_through_full_bytes(before: str, end: int, after: str) -> None:
    data = bytearray.fromhex(before)
    carry(data, end)
    assert data.hex(" ") == after


def test_an_encoder_that_said_nothing_has_no_bytes() -> None:
    code = ArithmeticState(None)
    code.reserve(3)
    assert len(code.buffer) == code.size > 0
    assert code.finished() == b""


def test_an_encoder_ends_with_the_shortest_number_of_its_interval() -> None:
    """From low on, the next number whose last three bytes are zero, which is rounded up into the bytes before."""
    code = ArithmeticState(None)
    code.started, code.low, code.range = 1, 0x12000001, 1 << 24
    assert code.finished() == b"\x13"
    code.reserve(2)
    code.buffer[:2], code.place, code.low = (0x41, 0xFF), 2, 0xFF000001
    assert code.finished() == b"\x42\x00\x00"


def test_a_decoder_is_whole_when_all_bytes_are_taken() -> None:
    code = ArithmeticState(b"\x01\x02")
    assert (code.encodes, code.size, code.is_exhausted()) == (False, 2, False), "there are bytes and none is taken"
    code.started = 1
    for place, whole, over in ((1 + AHEAD, False, False), (2 + AHEAD, True, False), (3 + AHEAD, False, True)):
        code.place = place
        assert (code.is_exhausted(), code.is_overrun()) == (whole, over)

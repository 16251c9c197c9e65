# SPDX-License-Identifier: Apache-2.0
"""The integer functions of the oracle against the formulas that docs/entropy.md gives for them."""

import math

import numpy as np

from structgstream.codec.entropy.models import HALF, ArithmeticState, Model
from structgstream.codec.entropy.reference_decisions import (
    FAR,
    LEAST,
    MOST,
    code_numbers,
    size_class,
    squashed,
    stretched,
)


def test_a_chance_is_the_logistic_function_of_its_logit() -> None:
    """Lines between 32 places of the curve: a fifth of a percent at most beside it, and never certain."""
    for logit in range(-FAR - 50, FAR + 51, 7):
        exact = 65536 / (1 + math.exp(-max(-FAR, min(FAR, logit)) / 256))
        assert abs(squashed(logit) - exact) < 140
        assert LEAST <= squashed(logit) <= MOST
        assert squashed(logit) + squashed(-logit) == 65536 or abs(logit) >= FAR


def test_a_logit_is_the_inverse_of_its_chance() -> None:
    table = stretched()
    assert (len(table), table[0], table[2048]) == (4096, -FAR, 1)
    for place in range(64, 4096 - 64):
        assert squashed(table[place] - 1) < 16 * place + 8 <= squashed(table[place])


def test_sizes_have_two_classes_an_octave_from_8_on() -> None:
    assert [size_class(size) for size in range(8)] == [*range(8)]
    assert [size_class(size) for size in (8, 11, 12, 15, 16, 23, 24, 31)] == [8, 8, 9, 9, 10, 10, 11, 11]
    assert [size_class(size) for size in (32, 48, 64, 96, 128, 2**30)] == [12, 13, 14, 15, 15, 15]


def test_a_chance_moves_half_of_the_way_then_a_third_then_a_quarter() -> None:
    """The rate of a cell is one over how many decisions it has seen, and two."""
    model, code = Model.new((1,), nodes=1), ArithmeticState(None)
    chance, expected = HALF, []
    for seen, yes in enumerate((1, 1, 0)):
        chance += ((65536 if yes else 0) - chance) * (65536 // (seen + 2)) >> 16
        expected.append(chance)
        values, contexts = np.array([yes], np.int64), np.zeros((1, 1), np.int32)
        code.reserve(1)
        assert code_numbers(code, model, contexts=contexts, values=values, flags=True)
        assert (model.chances[0, 0], model.seen[0, 0]) == (expected[-1], seen + 1)
    assert expected == [49152, 54613, 40959]

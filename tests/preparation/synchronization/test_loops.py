# SPDX-License-Identifier: Apache-2.0
"""Loops of lags that close, and those that do not."""

import pytest

from structgstream.preparation.synchronization.audio import PairLag, ambiguity_weights

STARTS = {"a": 0.0, "b": 1.2, "c": -0.4, "d": 2.5}


def lag(first: str, second: str, *, off: float = 0.0, rate: float = 0.0, fine: bool = True) -> PairLag:
    apart = STARTS[first] - STARTS[second] + off
    instants = tuple((at, apart + rate * at) for at in (2.0, 5.0, 9.0))
    return PairLag(first, second, instants, 1e-4, 2e-3, 1.0, fine)


@pytest.mark.parametrize("turned", [False, True])
def test_a_loop_that_closes_leaves_less(turned: bool) -> None:
    last = lag("c", "a") if turned else lag("a", "c")
    lags = [lag("a", "b"), lag("b", "c"), last, lag("c", "d")]
    assert ambiguity_weights(lags) == pytest.approx([1 / 3, 1 / 3, 1 / 3, 1])


def test_a_loop_that_does_not_close_leaves_all_doubt() -> None:
    assert ambiguity_weights([lag("a", "b"), lag("b", "c"), lag("a", "c", off=2e-3)]) == [1, 1, 1]
    assert ambiguity_weights([lag("a", "b"), lag("b", "c"), lag("a", "c", fine=False)]) == [1, 1, 1]


def test_loops_that_share_a_pair_support_each_other() -> None:
    pairs = [lag("a", "b"), lag("b", "c"), lag("a", "c"), lag("b", "d"), lag("c", "d")]
    assert ambiguity_weights(pairs) == pytest.approx([1 / 9] * 5)


def test_drift_does_not_open_a_loop() -> None:
    """Lags of c change by 1e-4 a second: 0.25 ms in the time by which clocks differ, 0.9 ms in the take."""
    lags = [lag("a", "b"), lag("b", "c", rate=1e-4), lag("a", "c", rate=1e-4)]
    assert ambiguity_weights(lags) == pytest.approx([1 / 3] * 3)

# SPDX-License-Identifier: Apache-2.0
"""Rows that mostly stay: both directions, and what the contexts are worth."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from structgstream.codec.coder import Contexts, Decoder, Encoder, Flags, Tables
from structgstream.codec.rows import ACTIVITY_CONTEXTS, RESIDUAL_CONTEXTS, Change, coded_change

GROUPS = (("anchor_positions", 0, 2), ("offset_scales", 2, 3))


@st.composite
def changes(draw: st.DrawFn) -> tuple[Change, Change]:
    """A change ``[n, 3]`` and the one before it, mostly zeros, with a few far values."""
    rows, seed = draw(st.integers(0, 40)), draw(st.integers(0, 2**32 - 1))
    g = np.random.default_rng(seed)
    share = draw(st.sampled_from([0.0, 0.1, 0.7, 1.0]))
    found = []
    for _ in range(2):
        values = np.rint(g.laplace(0, draw(st.sampled_from([0.5, 3.0, 1e6])), (rows, 3)))
        values[g.random(rows) >= share] = 0
        found.append(Change.of(values.astype(np.int32)))
    return found[0], found[1]


def written(change: Change, before: Change, *, groups=GROUPS) -> dict[str, bytes]:
    writer = Encoder(Tables())
    coded_change(writer, change, before, groups=groups)
    return writer.fields


@settings(max_examples=150, deadline=None)
@given(changes())
def test_a_change_comes_back(pair: tuple[Change, Change]) -> None:
    change, before = pair
    fields = written(change, before)
    assert fields.keys() == {"anchor_positions", "offset_scales"}
    reader = Decoder(Tables(), fields, where="Packet 0")  # type: ignore[arg-type]
    back = coded_change(reader, None, before, groups=GROUPS)
    reader.end()
    assert (back.active == change.active).all()
    assert (back.residuals == change.residuals).all()
    assert back.residuals.dtype == np.int32


def test_nothing_to_code_takes_nothing() -> None:
    before = Change.none(5, 0)
    assert coded_change(Encoder(Tables()), before, before, groups=()) is before


class Seen:
    """A coder that notes contexts and hands back what it is given."""

    def __init__(self) -> None:
        self.contexts: dict[str, list[int]] = {}

    def flags(self, name: str, values: Flags | None, contexts: Contexts, *, count: int) -> Flags:
        assert values is not None
        assert count == ACTIVITY_CONTEXTS
        assert (contexts < count).all()
        self.contexts[name] = contexts.tolist()
        return values

    def residuals(self, name: str, values, contexts: Contexts, *, count: int):
        assert count == RESIDUAL_CONTEXTS
        assert (contexts < count).all()
        self.contexts[name] = contexts.tolist()
        return values

    def naturals(self, name: str, values, contexts: Contexts, *, count: int):
        raise AssertionError("rows have no natural numbers")

    def number(self, name: str, value: int | None) -> int:
        raise AssertionError("rows have no numbers")


def test_contexts_are_those_of_the_document() -> None:
    before = [0, 1, 1, 0, 0, 0, 1, 1, 1, 1, 0]
    after = [1, 1, 0, 0, 1, 0, 0, 0, 1, 1, 1]
    seen = Seen()
    last = np.array([0, -1, 1, 0, 0, 0, 2, -9, -2, 1, 0], np.int32)[:, None]
    now = np.array([3, -1, 0, 0, 5, 0, 0, 0, -6, 1, -2], np.int32)[:, None]
    coded_change(seen, Change.of(now), Change.of(last), groups=[("a", 0, 1)])
    near = [sum(before[max(i - 3, 0) : i + 4]) - before[i] for i in range(11)]
    quarter = [min((n + 1) // 2, 3) for n in near]
    assert seen.contexts["a.active0"] == [(before[i] * 3 + 0) * 4 + quarter[i] for i in range(0, 11, 2)]
    beside = [after[i - 1] + after[i + 1] for i in range(1, 11, 2)]
    assert seen.contexts["a.active1"] == [
        (before[i] * 3 + b) * 4 + quarter[i] for i, b in zip(range(1, 11, 2), beside, strict=True)
    ]
    # Active rows are 0, 1, 4, 8, 9, 10; their last residuals 0, -1, 0, -2, 1, 0; now 3, -1, 5, -6, 1, -2.
    assert seen.contexts["a.change0"] == [(0 + 2) * 7 + 3, (0 + 2) * 7 + 3, (1 + 2) * 7 + 3]
    assert seen.contexts["a.change1"] == [(-1 + 2) * 7 + 3 + 3, (-2 + 2) * 7 + 3 + 3, (0 + 2) * 7 + 3 + 1]


@pytest.mark.parametrize("what", ["the same rows", "neighbours"])
def test_contexts_save_bytes(what: str) -> None:
    """Rows that move in runs, like those before them, are cheaper than as many strewn about."""
    g = np.random.default_rng(3)
    runs = np.repeat(g.random(200) < 0.1, 20)
    strewn = g.permutation(runs)

    def of(active: np.ndarray) -> Change:
        return Change.of(np.where(active, g.integers(1, 3, len(active)), 0)[:, None].repeat(3, 1).astype(np.int32))

    change = of(runs if what == "neighbours" else strewn)
    likely = Change.none(*change.residuals.shape) if what == "neighbours" else change
    unlike = of(strewn) if what == "neighbours" else Change.none(*change.residuals.shape)
    one = written(change, likely)
    other = written(change if what == "the same rows" else unlike, Change.none(*change.residuals.shape))
    assert 1.2 * sum(map(len, one.values())) < sum(map(len, other.values()))

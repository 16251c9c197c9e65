# SPDX-License-Identifier: Apache-2.0
"""Rows that mostly stay: both directions, and what the contexts are worth."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from structgstream.codec.entropy.adaptive import AdaptiveDecoder, AdaptiveEncoder
from structgstream.codec.entropy.decisions import Models
from structgstream.codec.fields.packet_fields import Change, code_change
from tests.support.properties import examples

GROUPS = (("anchor_positions", 0, 2), ("offset_scales", 2, 3))
NOTHING = {"anchor_positions": b"", "offset_scales": b""}


def drawn(g: np.random.Generator, rows: int, *, share: float, scale: float) -> np.ndarray:
    """Residuals ``[n, 3]``, mostly zeros, with a few far values."""
    values = np.clip(np.rint(g.laplace(0, scale, (rows, 3))), -(2**23), 2**23)
    values[g.random(rows) >= share] = 0
    return values.astype(np.int32)


@st.composite
def stories(draw: st.DrawFn) -> list[np.ndarray]:
    rows, seed = draw(st.integers(0, 120)), draw(st.integers(0, 2**32 - 1))
    g = np.random.default_rng(seed)
    shares, scales = st.sampled_from([0.0, 0.1, 0.7, 1.0]), st.sampled_from([0.5, 3.0, 60.0, 1e6])
    return [drawn(g, rows, share=draw(shares), scale=draw(scales)) for _ in range(draw(st.integers(1, 4)))]


def written(models: Models, residuals: np.ndarray, before: Change) -> tuple[dict[str, bytes], Change]:
    writer = AdaptiveEncoder(models, where="Frame 0")
    change = code_change(writer, Change.of(residuals), before, groups=GROUPS)
    return NOTHING | writer.fields(), change


@examples(60)
@given(stories())
def test_changes_come_back(frames: list[np.ndarray]) -> None:
    rows = len(frames[0])
    mine, its = Models(), Models()
    known = back = Change.none(rows, 3)
    for residuals in frames:
        mine, its = Models(mine), Models(its)
        fields, known = written(mine, residuals, known)
        reader = AdaptiveDecoder(its, fields, where="Packet 0")  # type: ignore[arg-type]
        back = code_change(reader, None, back, groups=GROUPS)
        reader.end()
        for one in (known, back):
            assert (one.residuals == residuals).all()
            assert (one.active == (residuals != 0).any(1)).all()
        assert (known.history == back.history).all()
        assert (known.sizes == back.sizes).all()


def test_what_stands_still_is_free() -> None:
    """45,000 rows, of which none moves: a few bits a packet, whatever moved before."""
    g = np.random.default_rng(1)
    models, change = Models(), Change.none(45_000, 3)
    _, change = written(models, drawn(g, 45_000, share=0.05, scale=2.0), change)
    sizes = []
    for _ in range(5):
        models = Models(models)
        fields, change = written(models, np.zeros((45_000, 3), np.int32), change)
        sizes.append(sum(map(len, fields.values())))
    assert sizes[0] < 300, "the first learns that it is over"
    assert max(sizes[3:]) <= 4


def test_history_goes_back_three_frames() -> None:
    models, change = Models(), Change.none(2, 3)
    for active, history in ((1, [1, 0]), (0, [2, 0]), (0, [4, 0]), (1, [1, 0]), (1, [3, 0])):
        _, change = written(models, np.array([[active, 0, 0], [0, 0, 0]], np.int32), change)
        assert change.history.tolist() == history


def test_models_of_a_packet_that_is_thrown_away_change_nothing() -> None:
    g = np.random.default_rng(5)
    one, two = (drawn(g, 100, share=0.5, scale=2.0) for _ in range(2))
    known, before = Models(), Change.none(100, 3)
    _, before = written(known, one, before)
    first = written(Models(known), two, before)[0]
    written(Models(known), one, before)
    assert written(Models(known), two, before)[0] == first

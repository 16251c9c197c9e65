# SPDX-License-Identifier: Apache-2.0
"""Free Gaussians come, change and go."""

import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from structgstream.codec.entropy.adaptive import AdaptiveDecoder, AdaptiveEncoder
from structgstream.codec.entropy.decisions import Models
from structgstream.codec.fields import packet_fields
from structgstream.codec.fields.packet_fields import MAX_FREE, Change, FreeBins, code_free
from structgstream.errors import StreamError
from tests.support.properties import examples


def free(births: list[int], *, seed: int = 0, scale: float = 20.0) -> FreeBins:
    g = np.random.default_rng(seed)
    bins = np.rint(g.laplace(0, scale, (len(births), 14))).astype(np.int32)
    return FreeBins(np.array(births, np.int64), bins, Change.none(len(births), 14))


def new_encoder() -> AdaptiveEncoder:
    return AdaptiveEncoder(Models(), where="Frame 0")


def fields_of(writer: AdaptiveEncoder) -> dict[str, bytes]:
    """What was written; a field without a decision has no bytes."""
    return {"free": b"", "free_births": b""} | writer.fields()


def exchange(after: FreeBins, before: FreeBins, models: tuple[Models, Models] | None = None) -> FreeBins:
    """What a decoder finds; checks that the encoder thinks the same."""
    mine, its = models or (Models(), Models())
    writer = AdaptiveEncoder(mine, where="Frame 0")
    known = code_free(writer, after, before, where="Packet 0")
    reader = AdaptiveDecoder(its, fields_of(writer), where="Packet 0")  # type: ignore[arg-type]
    back = code_free(reader, None, before, where="Packet 0")
    reader.end()
    for one, other in ((known, back), (after, back)):
        assert (one.births == other.births).all()
        assert (one.bins == other.bins).all()
    assert (known.change.history == back.change.history).all()
    assert (known.change.sizes == back.change.sizes).all()
    assert (known.change.residuals == back.change.residuals).all()
    return back


@examples(25)
@given(st.integers(0, 2**32 - 1), st.lists(st.tuples(st.integers(0, 4), st.sampled_from([0.0, 0.5, 1.0])), max_size=6))
def test_a_life_comes_back(seed: int, frames: list[tuple[int, float]]) -> None:
    """In every frame some die, some change and some are spawned, several at once, with gaps in their numbers."""
    g = np.random.default_rng(seed)
    now, models = FreeBins.none(), (Models(), Models())
    for frame, (spawned, survive) in enumerate(frames):
        stay = g.random(len(now.births)) < survive
        bins = now.bins[stay] + np.where(g.random((stay.sum(), 1)) < 0.5, g.integers(-9, 10, (stay.sum(), 14)), 0)
        numbers = np.sort(g.choice([0, 1, 2, 7, 1000, 2**31 - 1], spawned, replace=False))
        births = np.concatenate([now.births[stay], frame * 2**32 + numbers])
        bins = np.concatenate([bins, g.integers(-(2**22), 2**22 + 1, (spawned, 14))]).astype(np.int32)
        now = exchange(FreeBins(births, bins, Change.none(len(births), 14)), now, models)


def test_births_of_several_frames_at_once() -> None:
    """A key packet holds all that are alive, from whatever frames, the first perhaps from frame 0."""
    for births in ([0, 1, 5], [3], [2**32, 2**32 + 2**31 - 1, 7 * 2**32, 7 * 2**32 + 1], [(2**31 - 1) << 32]):
        assert exchange(free(births), FreeBins.none()).births.tolist() == births


def test_what_changed_is_remembered_and_what_is_spawned_did_not_change() -> None:
    before = free([1, 2, 3])
    bins = before.bins[1:].copy()
    bins[0, 4] += 3
    after = FreeBins(np.array([2, 3, 9]), np.concatenate([bins, before.bins[:1]]), before.change)
    found = exchange(after, before)
    assert found.change.active.tolist() == [True, False, False]
    assert found.change.residuals.sum() == 3
    assert not found.without_change().change.active.any()


@pytest.mark.parametrize(
    ("births", "before", "message"),
    [
        ([3, 2], [], "births that do not ascend"),
        ([-1, 2], [], "births below 0"),
        ([2**31], [], "beyond 31 bits"),
        ([1, 2, 5], [2, 3], "births that do not ascend"),
    ],
)
def test_births_that_cannot_be_coded(births: list[int], before: list[int], message: str) -> None:
    with pytest.raises(StreamError, match=message):
        code_free(new_encoder(), free(births), free(before), where="Frame 0")


def hostile(count: int, frames: list[int], numbers: list[int]) -> FreeBins:
    """What a decoder makes of births that no encoder writes."""
    writer, nothing = new_encoder(), np.zeros(len(frames), np.int32)
    writer.numbers("free_births.count", np.array([count]), [np.zeros(1, np.int32)], counts=[1])
    writer.numbers("free_births.frame", np.array(frames, np.int64), [nothing], counts=[1])
    writer.numbers("free_births.number", np.array(numbers, np.int64), [np.array(frames) != 0], counts=[2])
    for column in range(14):
        column_, other = np.full(len(frames), column), np.full(len(frames), column * 13)
        inputs = [column_, other * 3 + 1, other]
        writer.numbers("free.born", np.zeros(len(frames), np.int64), inputs, counts=[14, 546, 182])
    reader = AdaptiveDecoder(Models(), fields_of(writer), where="Packet 0")  # type: ignore[arg-type]
    found = code_free(reader, None, FreeBins.none(), where="Packet 0")
    reader.end()
    return found


@pytest.mark.parametrize(
    ("count", "frames", "numbers", "message"),
    [
        (MAX_FREE + 1, [], [], "adds 262145 free Gaussians, which makes more than 262144"),
        (2**31 - 1, [], [], "makes more than 262144"),
        (-1, [], [], "or fewer than none"),
        (2, [2**31 - 1, 2**31 - 1], [1, 1], "births beyond 63 bits"),
        (1, [-1], [1], "births beyond 63 bits"),
        (1, [0], [-1], "births beyond 63 bits"),
        (3, [1, 0, 0], [2**31 - 1] * 3, "births beyond 63 bits"),
        (2, [1, 0], [5, 0], "births that do not ascend"),
        (2, [1, 0], [5, -1], "births that do not ascend"),
    ],
)
def test_births_that_no_encoder_writes(count: int, frames: list[int], numbers: list[int], message: str) -> None:
    with pytest.raises(StreamError, match=message):
        hostile(count, frames, numbers)


def test_births_that_an_encoder_may_write() -> None:
    """The way in which the others are made is right."""
    assert hostile(2, [1, 0], [5, 1]).births.tolist() == [2**32 + 5, 2**32 + 6]


def test_a_count_is_refused_before_anything_is_made_of_it() -> None:
    tracemalloc.start()
    try:
        with pytest.raises(StreamError, match="more than 262144"):
            hostile(2**31 - 1, [], [])
        assert tracemalloc.get_traced_memory()[1] < 2**20
    finally:
        tracemalloc.stop()


def test_the_most_that_few_bytes_can_make(monkeypatch: pytest.MonkeyPatch) -> None:
    """Births that differ by nothing take no bits: only the limit bounds them, also over several packets."""
    monkeypatch.setattr(packet_fields, "MAX_FREE", 2**12)
    many = FreeBins(np.arange(1, 2**12 + 1), np.zeros((2**12, 14), np.int32), Change.none(2**12, 14))
    writer = new_encoder()
    code_free(writer, many, FreeBins.none(), where="")
    assert sum(map(len, writer.fields().values())) < 200
    assert len(exchange(many, FreeBins.none()).births) == 2**12
    more = FreeBins(np.arange(1, 2**12 + 2), np.zeros((2**12 + 1, 14), np.int32), many.change)
    with pytest.raises(StreamError, match="adds 1 free Gaussians, which makes more than"):
        code_free(new_encoder(), more, many, where="Frame 1")


def test_rows_that_stay_keep_their_change_and_new_ones_have_none() -> None:
    residuals = np.array([[0, 0], [1, -2], [300, 300], [0, -1]], np.int32)
    change = Change.of(residuals).select(np.array([False, True, False, True])).extended(2)
    assert change.residuals.tolist() == [[1, -2], [0, -1], [0, 0], [0, 0]]
    assert change.history.tolist() == [1, 1, 0, 0]
    assert change.sizes.tolist() == [3, 1, 0, 0]

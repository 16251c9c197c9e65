# SPDX-License-Identifier: Apache-2.0
"""Free Gaussians come, change and go."""

import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from structgstream.codec import free_rows
from structgstream.codec.coder import Decoder, Encoder, Tables, varint
from structgstream.codec.free_rows import MOST_FREE, FreeBins, coded_free
from structgstream.codec.rows import Change
from structgstream.errors import StreamError


def free(births: list[int], *, seed: int = 0, scale: float = 20.0) -> FreeBins:
    g = np.random.default_rng(seed)
    bins = np.rint(g.laplace(0, scale, (len(births), 14))).astype(np.int32)
    return FreeBins(np.array(births, np.int64), bins, Change.none(len(births), 14))


def exchange(after: FreeBins, before: FreeBins, tables: tuple[Tables, Tables] | None = None) -> FreeBins:
    """What a decoder finds; checks that the encoder thinks the same."""
    mine, its = tables or (Tables(), Tables())
    writer = Encoder(mine)
    known = coded_free(writer, after, before, where="Packet 0")
    reader = Decoder(its, writer.fields, where="Packet 0")  # type: ignore[arg-type]
    back = coded_free(reader, None, before, where="Packet 0")
    reader.end()
    for one, other in ((known, back), (after, back)):
        assert (one.births == other.births).all()
        assert (one.bins == other.bins).all()
    assert (known.change.active == back.change.active).all()
    assert (known.change.residuals == back.change.residuals).all()
    return back


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.lists(st.tuples(st.integers(0, 4), st.sampled_from([0.0, 0.5, 1.0])), max_size=6))
def test_a_life_comes_back(seed: int, frames: list[tuple[int, float]]) -> None:
    """In every frame some die, some change and some are born, several at once, with gaps in their numbers."""
    g = np.random.default_rng(seed)
    now, tables = FreeBins.none(), (Tables(), Tables())
    for frame, (born, survive) in enumerate(frames):
        stay = g.random(len(now.births)) < survive
        bins = now.bins[stay] + np.where(g.random((stay.sum(), 1)) < 0.5, g.integers(-9, 10, (stay.sum(), 14)), 0)
        numbers = np.sort(g.choice([0, 1, 2, 7, 1000, 2**31 - 1], born, replace=False))
        births = np.concatenate([now.births[stay], frame * 2**32 + numbers])
        bins = np.concatenate([bins, g.integers(-(2**22), 2**22 + 1, (born, 14))]).astype(np.int32)
        now = exchange(FreeBins(births, bins, Change.none(len(births), 14)), now, tables)


def test_births_of_several_frames_at_once() -> None:
    """A key packet holds all that are alive, from whatever frames, the first perhaps from frame 0."""
    for births in ([0, 1, 5], [3], [2**32, 2**32 + 2**31 - 1, 7 * 2**32, 7 * 2**32 + 1], [(2**31 - 1) << 32]):
        assert exchange(free(births), FreeBins.none()).births.tolist() == births


def test_what_changed_is_remembered_and_what_is_born_did_not_change() -> None:
    before = free([1, 2, 3])
    bins = before.bins[1:].copy()
    bins[0, 4] += 3
    after = FreeBins(np.array([2, 3, 9]), np.concatenate([bins, before.bins[:1]]), before.change)
    found = exchange(after, before)
    assert found.change.active.tolist() == [True, False, False]
    assert found.change.residuals.sum() == 3
    assert not found.unmoved().change.active.any()


@pytest.mark.parametrize(
    ("births", "before", "message"),
    [
        ([3, 2], [], "beyond 31 bits"),
        ([-1, 2], [], "births below 0"),
        ([2**31], [], "beyond 31 bits"),
        ([1, 2, 5], [2, 3], "births that do not ascend"),
    ],
)
def test_births_that_cannot_be_coded(births: list[int], before: list[int], message: str) -> None:
    with pytest.raises(StreamError, match=message):
        coded_free(Encoder(Tables()), free(births), free(before), where="Frame 0")


def hostile(count: int, frames: list[int], numbers: list[int]) -> FreeBins:
    """What a decoder makes of births that no encoder writes."""
    writer, nothing = Encoder(Tables()), np.zeros(len(frames), np.uint16)
    writer.flags("free_births.alive", np.zeros(0, bool), np.zeros(0, np.uint16), count=2)
    coded_free(part := Encoder(Tables()), FreeBins.none(), FreeBins.none(), where="")
    writer.number("free_births.count", count)
    writer.fields["free"] = part.fields["free"]
    if frames:
        writer.naturals("free_births.frame", np.array(frames), nothing, count=1)
        fresh = (np.array(frames) > 0).astype(np.uint16)
        writer.naturals("free_births.number", np.array(numbers), fresh, count=2)
        columns = np.tile(np.arange(14, dtype=np.uint16), len(frames))
        writer.naturals("free.born", np.full(14 * len(frames), 2**31 - 1), columns, count=14)
    reader = Decoder(Tables(), writer.fields, where="Packet 0")  # type: ignore[arg-type]
    return coded_free(reader, None, FreeBins.none(), where="Packet 0")


@pytest.mark.parametrize(
    ("count", "frames", "numbers", "message"),
    [
        (MOST_FREE + 1, [], [], "adds 262145 free Gaussians, which makes more than 262144"),
        (2**32 - 1, [], [], "makes more than 262144"),
        (2, [2**31 - 1, 2**31 - 1], [1, 1], "births beyond 63 bits"),
        (3, [1, 0, 0], [2**31 - 1] * 3, "births beyond 63 bits"),
        (2, [1, 0], [5, 0], "births that do not ascend"),
    ],
)
def test_births_that_no_encoder_writes(count: int, frames: list[int], numbers: list[int], message: str) -> None:
    with pytest.raises(StreamError, match=message):
        hostile(count, frames, numbers)


def test_a_count_is_refused_before_anything_is_made_of_it() -> None:
    writer = Encoder(Tables())
    coded_free(writer, FreeBins.none(), FreeBins.none(), where="")
    births = writer.fields["free_births"]
    assert births[-1:] == b"\0"
    fields = {**writer.fields, "free_births": births[:-1] + varint(2**31)}
    decoder = Decoder(Tables(), fields, where="Packet 0")  # type: ignore[arg-type]
    tracemalloc.start()
    try:
        with pytest.raises(StreamError, match="more than 262144"):
            coded_free(decoder, None, FreeBins.none(), where="Packet 0")
        assert tracemalloc.get_traced_memory()[1] < 2**20
    finally:
        tracemalloc.stop()


def test_the_most_that_few_bytes_can_make(monkeypatch: pytest.MonkeyPatch) -> None:
    """Births that differ by nothing take no bits: only the limit bounds them, also over several packets."""
    monkeypatch.setattr(free_rows, "MOST_FREE", 2**12)
    many = FreeBins(np.arange(1, 2**12 + 1), np.zeros((2**12, 14), np.int32), Change.none(2**12, 14))
    writer = Encoder(Tables())
    coded_free(writer, many, FreeBins.none(), where="")
    assert sum(map(len, writer.fields.values())) < 200
    assert len(exchange(many, FreeBins.none()).births) == 2**12
    more = FreeBins(np.arange(1, 2**12 + 2), np.zeros((2**12 + 1, 14), np.int32), many.change)
    with pytest.raises(StreamError, match="adds 1 free Gaussians, which makes more than"):
        coded_free(Encoder(Tables()), more, many, where="Frame 1")


def test_a_birth_takes_few_bytes() -> None:
    writer = Encoder(Tables())
    many = free([2**32 + i for i in range(300)], scale=20.0)
    coded_free(writer, many, FreeBins.none(), where="")
    assert sum(map(len, writer.fields.values())) / 300 < 14, "6 to 7 bits an attribute"

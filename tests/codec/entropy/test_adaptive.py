# SPDX-License-Identifier: Apache-2.0
"""One description, two directions: each kind of array comes back, and every kind of damage has its sentence."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from structgstream.codec.entropy.adaptive import AdaptiveCoder, AdaptiveDecoder, AdaptiveEncoder
from structgstream.codec.entropy.decisions import LARGEST_NUMBER, Models
from structgstream.errors import StreamError

HISTORY = np.array([1, 0, 7, 3, 0, 0, 1, 2] * 6, np.uint8)
ACTIVE = HISTORY % 2 == 1
ROWS = int(ACTIVE.sum())
SIZES = np.arange(len(HISTORY), dtype=np.int32) % 5
LAST = np.arange(3 * ROWS, dtype=np.int32).reshape(ROWS, 3) % 7 - 3
RESIDUALS = np.roll(LAST, 1, axis=0)
FLAGS = np.arange(ROWS) % 3 == 0
NUMBERS = np.array([0, -1, 5, LARGEST_NUMBER, -LARGEST_NUMBER, *range(ROWS - 5)], np.int64)
INPUTS = [np.arange(ROWS) % 2, np.arange(ROWS) % 3, np.zeros(ROWS, int)]
COUNTS = (2, 3, 1)


def described(coder: AdaptiveCoder, *, known: bool) -> list[NDArray]:
    """Four arrays in three fields; with ``known`` they are given, without they are asked for."""
    return [
        coder.activity("a.rows", ACTIVE if known else None, history=HISTORY, sizes=SIZES),
        coder.residuals("a.residuals", RESIDUALS if known else None, last=LAST, others=SIZES[:ROWS]),
        coder.flags("b.flags", FLAGS if known else None, INPUTS, counts=COUNTS),
        coder.numbers("c", NUMBERS if known else None, INPUTS, counts=COUNTS),
    ]


def read_to_the_end(decoder: AdaptiveDecoder) -> None:
    described(decoder, known=False)
    decoder.end()


def encoded(models: Models | None = None) -> dict[Any, bytes]:
    encoder = AdaptiveEncoder(models or Models(), where="Packet 7")
    described(encoder, known=True)
    return encoder.fields()


def test_the_same_description_writes_and_reads() -> None:
    fields = encoded()
    assert [*fields] == ["a", "b", "c"]
    decoder = AdaptiveDecoder(Models(), fields, where="Packet 7")
    for found, wanted in zip(described(decoder, known=False), (ACTIVE, RESIDUALS, FLAGS, NUMBERS), strict=True):
        assert found.dtype == wanted.dtype
        assert (found == wanted).all()
    decoder.end()


def test_what_was_seen_before_makes_a_packet_smaller() -> None:
    models = Models()
    first = encoded(models)
    second = encoded(Models(models))
    assert sum(map(len, second.values())) < 0.9 * sum(map(len, first.values()))


def test_nothing_takes_no_byte() -> None:
    encoder, none = AdaptiveEncoder(Models(), where="Packet 7"), np.zeros(0, np.int64)
    assert encoder.numbers("c", none, [none], counts=(2,)).shape == (0,)
    assert encoder.residuals("a", np.zeros((0, 3), np.int32), last=LAST[:0], others=SIZES[:0]).shape == (0, 3)
    assert encoder.fields() == {}


def test_numbers_that_no_decoder_takes_are_refused_by_the_encoder() -> None:
    encoder = AdaptiveEncoder(Models(), where="Packet 7")
    with pytest.raises(StreamError, match="beyond 31 bits"):
        encoder.numbers("c", np.array([LARGEST_NUMBER + 1]), [np.zeros(1, int)], counts=(1,))
    with pytest.raises(StreamError, match=r"Packet 7 changes a\.x by more than can be coded; take a larger step"):
        encoder.residuals("a.x", np.array([[2**23 + 1]], np.int32), last=LAST[:1, :1] * 0, others=SIZES[:1])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"b": None}, "Packet 7 holds no b, which the header announces"),
        ({"b": b""}, "Packet 7 ends too early in b"),
        ({"c": b""}, "Packet 7, c, holds a number out of bounds"),
        ({"a": 9}, "bytes of a, which are not all"),
    ],
)
def test_damage_is_reported_with_its_place(change: dict[str, bytes | int | None], words: str) -> None:
    """A field that is missing, too short, senseless, or goes on where it should end."""
    fields = encoded()
    for name, data in change.items():
        if data is None:
            del fields[name]
        else:
            fields[name] = fields[name] + bytes(data) if isinstance(data, int) else data
    decoder = AdaptiveDecoder(Models(), fields, where="Packet 7")
    with pytest.raises(StreamError, match=rf"{words}.*is damaged"):
        read_to_the_end(decoder)

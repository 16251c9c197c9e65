# SPDX-License-Identifier: Apache-2.0
"""The coded fields of the init record."""

from collections.abc import Mapping
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from structgstream.codec.entropy.bits import varint
from structgstream.codec.entropy.rans import SectionEncoder
from structgstream.codec.fields.quantization import round_to_bins
from structgstream.codec.fields.static_fields import (
    FREE_NUMBERS,
    MAX_ANCHORS,
    MAX_WEIGHTS,
    UNCODED_FIELDS,
    decode_fields,
    encode_fields,
    max_columns,
)
from structgstream.errors import StreamError
from structgstream.scene.appearance import with_appearance
from structgstream.scene.order import morton_order
from structgstream.scene.state import STATE_TABLE, FieldName, state_of
from tests.support.properties import examples
from tests.support.streams import small_scene

CODED: tuple[FieldName, ...] = tuple(row.name for row in STATE_TABLE if row.name not in UNCODED_FIELDS)
STEPS: dict[FieldName, float] = {name: float(np.float32(0.01 + i / 100)) for i, name in enumerate(CODED)}


def fields_of(anchors: int = 5, *, seed: int = 0, scale: float = 1.0) -> dict[FieldName, torch.Tensor]:
    """Fields of a small scene with an appearance, on bins."""
    scene = replace(
        with_appearance(small_scene(anchors, seed=seed), 2), environment=torch.arange(12.0).reshape(4, 3) - 5
    )
    state = state_of(scene)
    return round_to_bins({name: state[name] * scale for name in CODED}, STEPS)


def row(**changes: torch.Tensor) -> dict[FieldName, torch.Tensor]:
    """:func:`fields_of` with some fields replaced by these bins times their steps."""
    changed: dict[FieldName, torch.Tensor] = {
        name: torch.from_numpy(changes[name].numpy().astype(np.float32) * np.float32(STEPS[name]))
        for name in CODED
        if name in changes
    }
    return fields_of() | changed


@cache
def three_anchors() -> dict[FieldName, bytes]:
    return encode_fields(fields_of(3), STEPS)


def check(fields: Mapping[FieldName, torch.Tensor]) -> int:
    """Comes back bit for bit; the size in bytes."""
    coded = encode_fields(fields, STEPS)
    back = decode_fields(coded, STEPS)
    assert list(back) == sorted(fields, key=CODED.index) or back.keys() == fields.keys()
    for name, value in fields.items():
        assert back[name].dtype == torch.float32
        assert back[name].shape == value.shape, name
        assert back[name].numpy().tobytes() == value.numpy().tobytes(), name
    return sum(len(data) for data in coded.values())


@pytest.mark.parametrize(("anchors", "scale"), [(0, 1.0), (1, 1e-3), (2, 300.0), (5, 1.0), (100, 300.0)])
def test_fields_come_back(anchors: int, scale: float) -> None:
    check(fields_of(anchors, scale=scale))


def test_without_appearance() -> None:
    fields = fields_of()
    check({name: value for name, value in fields.items() if not name.startswith("appearance")})


@examples(40)
@given(st.lists(st.lists(st.integers(-(2**19), 2**19 - 1), min_size=3, max_size=3), max_size=12), st.booleans())
def test_positions_in_any_order(cells: list[list[int]], ordered: bool) -> None:
    bins = torch.tensor(cells, dtype=torch.int32).reshape(-1, 3)
    step = STEPS["anchor_positions"]
    positions = torch.from_numpy(bins.numpy().astype(np.float32) * np.float32(step))
    if ordered:
        positions = positions[morton_order(positions, step=step)]
    fields: dict[FieldName, torch.Tensor] = {"anchor_positions": positions}
    check(fields)


def test_the_corners_of_what_positions_may_be() -> None:
    low, high = -(2**22), -(2**22) + 2**20 - 1
    check(row(anchor_positions=torch.tensor([[low, 2**22, 0], [high, 2**22 - 2**20 + 1, 5]] + [[low, 2**22, 0]] * 3)))
    apart = torch.zeros(5, 3, dtype=torch.int32)
    apart[2, 1] = 2**20
    with pytest.raises(StreamError, match=r"Anchors are 1048576 steps apart, at most 2\^20; take a larger step"):
        encode_fields(row(anchor_positions=apart), STEPS)


def test_shifts_and_large_numbers() -> None:
    g = torch.Generator().manual_seed(2)
    for power in (0, 3, 8):
        bins = torch.randint(-(2**22 >> power), (2**22 >> power) + 1, (5, 3), generator=g) << power
        bins[3] = 0
        bins[0, 0] = -(2**22)
        check(row(base_scales=bins, anchor_offsets=torch.cat([bins, -bins], dim=1).reshape(5, 2, 3)))


def test_numbers_that_no_bin_stands_for() -> None:
    fields = fields_of()
    for wrong in (fields["anchor_features"] + 1e-4, -0.0 * fields["anchor_features"].abs()):
        with pytest.raises(StreamError, match="header's anchor_features are no multiples of the step 0.05; quantize"):
            encode_fields({**fields, "anchor_features": wrong}, STEPS)
    for wrong in (torch.nan, torch.inf, 1e9):
        with pytest.raises(StreamError, match="steps from zero"):
            encode_fields({**fields, "anchor_features": torch.full((5, 2), wrong)}, STEPS)


def test_steps_that_are_missing() -> None:
    fields = fields_of()
    less: dict[FieldName, float] = {name: step for name, step in STEPS.items() if name != "color_mlp"}
    with pytest.raises(StreamError, match="states no step for color_mlp in the init record"):
        encode_fields(fields, less)
    with pytest.raises(StreamError, match="states no step for color_mlp in the init record"):
        decode_fields(encode_fields(fields, STEPS), less)


def test_fields_without_a_coding() -> None:
    coded = encode_fields(fields_of(), STEPS)
    with pytest.raises(StreamError, match="holds camera_color coded; expected raw"):
        decode_fields({**coded, "camera_color": b""}, STEPS)
    assert encode_fields({**fields_of(), "camera_color": torch.ones(2, 6) / 3}, STEPS) == coded
    less: dict[FieldName, bytes] = {name: data for name, data in coded.items() if name != "anchor_positions"}
    with pytest.raises(StreamError, match=r"anchor_positions\.rows, holds a number that is cut"):
        decode_fields(less, STEPS)
    less = {name: data for name, data in coded.items() if name != "appearance"}
    with pytest.raises(StreamError, match="holds appearance_basis without appearance, which determines its shape"):
        decode_fields(less, STEPS)


def test_more_numbers_than_allowed_are_refused() -> None:
    coded = encode_fields(fields_of(), STEPS)
    limits: dict[FieldName, int] = {"anchor_positions": MAX_ANCHORS, "color_mlp": MAX_WEIGHTS}
    limits |= {row.name: max_columns(row.name) for row in STATE_TABLE if row.init_coding == "rows"}
    assert [*limits.values()][2:] == [3, 3, 3 * 64, 256, 256]
    for name, most in limits.items():
        rest = coded[name][1:]
        with pytest.raises(StreamError, match=f"has {most + 1} .*at most {most} are allowed"):
            decode_fields({**coded, name: varint(most + 1) + rest}, STEPS)
        if most != 3:
            with pytest.raises(StreamError, match="damaged|not fit"):
                decode_fields({**coded, name: varint(most) + rest}, STEPS)


def test_few_bytes_do_not_make_many_numbers() -> None:
    """A section whose symbols take no bits has any number of anchors in a few bytes, and 256 columns for each."""

    def positions(anchors: int) -> bytes:
        return encode_fields({"anchor_positions": torch.zeros(anchors, 3)}, STEPS)["anchor_positions"]

    most = FREE_NUMBERS // 3
    assert len(positions(most)) < 60
    assert decode_fields({"anchor_positions": positions(most)}, STEPS)["anchor_positions"].shape == (most, 3)
    with pytest.raises(StreamError, match="numbers, more than the .* take smaller steps"):
        positions(most + 2000)
    message = "The init record has more than 64 numbers per byte; it is damaged"
    with pytest.raises(StreamError, match=message):
        decode_fields({"anchor_positions": varint(most + 2000) + positions(most)[3:]}, STEPS)
    anchors = FREE_NUMBERS // 256
    encoder = SectionEncoder()
    encoder.number("anchor_features.columns", 256)
    many: dict[FieldName, bytes] = {
        "anchor_positions": positions(anchors),
        "anchor_features": encoder.fields["anchor_features"],
    }
    with pytest.raises(StreamError, match=message):
        decode_fields(many, STEPS)
    # As many more as bytes are there.
    with pytest.raises(StreamError, match="anchor_features.* holds a number that is cut"):
        decode_fields({**many, "color_mlp": bytes(256)}, STEPS)


def test_offsets_and_directions_that_do_not_fit() -> None:
    coded = encode_fields(fields_of(), STEPS)
    with pytest.raises(StreamError, match="damaged|not fit"):
        decode_fields({**coded, "anchor_offsets": coded["anchor_features"]}, STEPS)
    with pytest.raises(StreamError, match=r"holds 2 numbers of appearance_basis, which do not fit \(2, 2\)"):
        decode_fields({**coded, "appearance_basis": numbers_alone("appearance_basis", 2)}, STEPS)


def test_an_environment_of_no_whole_rows() -> None:
    coded = encode_fields(fields_of(), STEPS)
    with pytest.raises(StreamError, match=r"holds 4 numbers of environment, which do not fit \(1, 3\)"):
        decode_fields({**coded, "environment": numbers_alone("environment", 4)}, STEPS)


def numbers_alone(name: str, count: int) -> bytes:
    """A field of so many numbers, whether or not they fit the other fields."""
    encoder = SectionEncoder()
    encoder.number(f"{name}.count", count)
    encoder.naturals(f"{name}.value", np.arange(count), np.zeros(count, np.uint16), count=1)
    return encoder.fields[name]


@examples(100)
@given(st.data())
def test_any_bytes_give_fields_or_one_kind_of_error(data: st.DataObject) -> None:
    coded = three_anchors()
    name = data.draw(st.sampled_from(CODED))
    try:
        decode_fields({**coded, name: data.draw(st.binary(max_size=40))}, STEPS)
    except StreamError:
        return

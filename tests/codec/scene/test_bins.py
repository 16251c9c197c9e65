# SPDX-License-Identifier: Apache-2.0
"""Values and the whole numbers that stand for them."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from structgstream.codec.fields.packet_fields import CODABLE, dequantize_state, quantize_state, quantized_fields
from structgstream.codec.fields.quantization import LARGEST
from structgstream.errors import StreamError
from structgstream.scene.appearance import with_appearance
from structgstream.scene.state import PAPER_DYNAMIC, FieldName, state_of
from tests.support.properties import examples
from tests.support.rigs import random_scene
from tests.support.streams import STEPS

AWKWARD = {name: float(np.float32(0.013 * (i + 1))) for i, name in enumerate(STEPS)}


@pytest.mark.parametrize("dynamic", [CODABLE, PAPER_DYNAMIC, frozenset({"free", "free_births"}), frozenset()])
def test_bins_of_the_values_of_bins_are_the_same_bins(dynamic: frozenset[FieldName]) -> None:
    state = state_of(with_appearance(random_scene(7, free=5), 4))
    bins = quantize_state(state, dynamic, AWKWARD)
    values = dequantize_state(bins, dynamic, AWKWARD)
    assert values.keys() == dynamic
    again = quantize_state({**state, **values}, dynamic, AWKWARD)
    assert (again.anchors == bins.anchors).all()
    assert (again.free.bins == bins.free.bins).all()
    assert all((again.weights[name] == found).all() for name, found in bins.weights.items())
    for name, value in values.items():
        assert value.dtype == state[name].dtype
        assert value.shape == state[name].shape
    for name in dynamic & AWKWARD.keys():
        assert ((values[name] - state[name]).abs() <= 0.5001 * AWKWARD[name]).all(), name


@examples(100)
@given(st.integers(-LARGEST, LARGEST), st.floats(2.0**-64, 2.0**64, width=32))
def test_a_value_is_one_product_of_two_float32(bin: int, step: float) -> None:
    """What any decoder computes: two float32, one multiplication, rounded to nearest."""
    state = state_of(random_scene(1))
    positions = torch.from_numpy(np.full((1, 3), np.float32(bin) * np.float32(step)))
    rows: frozenset[FieldName] = frozenset({"anchor_positions"})
    bins = quantize_state({**state, "anchor_positions": positions}, rows, {"anchor_positions": step})
    assert bins.anchors.tolist() == [[bin] * 3]
    assert torch.equal(dequantize_state(bins, rows, {"anchor_positions": step})["anchor_positions"], positions)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), (LARGEST + 1) * 2.0**-6, -3e38])
def test_a_value_that_no_bin_stands_for(value: float) -> None:
    state = state_of(random_scene(3))
    state["anchor_positions"][1, 2] = value
    with pytest.raises(StreamError, match="steps from zero, at most 4194304 can be coded"):
        quantize_state(state, frozenset({"anchor_positions"}), STEPS)


def test_columns_stand_in_the_order_of_the_state_table() -> None:
    assert quantized_fields("anchor") == ("anchor_positions", "offset_scales", "base_scales", "appearance")
    state = state_of(with_appearance(random_scene(2, free=1), 4))
    state["offset_scales"] = torch.tensor([[1.0, 2, 3], [4, 5, 6]]) / 64
    state["appearance"] = torch.arange(1, 9).reshape(2, 4) / 64
    state["free"] = torch.arange(14)[None] / 64
    found = quantize_state(state, CODABLE, STEPS)
    assert [end - first for _, first, end in found.columns] == [3, 3, 3, 4]
    assert found.anchors[:, 3:6].tolist() == [[1, 2, 3], [4, 5, 6]]
    assert found.anchors[:, 9:].tolist() == [[1, 2, 3, 4], [5, 6, 7, 8]]
    assert found.free.bins.tolist() == [[*range(14)]]
    widths = {"free_means": 3, "free_log_scales": 3, "free_quats": 4, "free_logit_opacities": 1, "free_colors": 3}
    steps = STEPS | {name: 2.0**-7 * (i + 1) for i, name in enumerate(widths)}
    coarse = quantize_state(state, CODABLE, steps)
    expected = [round(2 * column / (i + 1)) for i, column in zip(np.repeat(range(5), [*widths.values()]), range(14))]
    assert coarse.free.bins.tolist() == [expected]

# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace
from typing import get_args

import pytest
import torch

from structgstream.errors import ConfigError
from structgstream.scene.appearance import with_appearance
from structgstream.scene.state import (
    FREE_COLUMNS,
    PAPER_DYNAMIC,
    PARAMETERS,
    STATE_TABLE,
    FieldName,
    fields_of,
    parameters_of,
    scene_of,
    state_of,
    tensor_of,
    with_dynamic_fields,
)
from tests.support.rigs import random_scene
from tests.support.streams import same


@pytest.mark.parametrize("options", [(), ("appearance", "environment")])
def test_state_and_scene_are_inverse(options: tuple[str, ...]) -> None:
    scene = random_scene(free=4)
    if options:
        scene = replace(with_appearance(scene, 3), environment=torch.rand(9, 3))
    state = state_of(scene)
    assert set(state) == {row.name for row in STATE_TABLE if row.optional is None or row.optional in options}
    assert same(scene_of(state, distance_input=True), scene)


def test_codes_and_names_are_never_shared() -> None:
    codes, names = [f.code for f in STATE_TABLE], [parameter.name for parameter in PARAMETERS]
    assert len(set(codes)) == len(codes)
    assert len(set(names)) == len(names)
    assert [row.name for row in STATE_TABLE] == list(get_args(FieldName))


def test_parameters_are_the_columns_of_their_field() -> None:
    scene = replace(with_appearance(random_scene(free=4), 3), environment=torch.rand(9, 3))
    for row in (row for row in STATE_TABLE if row.name in state_of(scene)):
        found = [tensor_of(scene, parameter) for parameter in row.parameters]
        joined = [value.reshape(len(value), -1) for value in found if value is not None]
        assert torch.equal(torch.cat(joined, dim=1), state_of(scene)[row.name].reshape(len(joined[0]), -1))
        assert not row.parts or row.shape[-1] == sum(parameter.columns for parameter in row.parts)


def test_every_field_has_rows_of_one_kind() -> None:
    assert fields_of("free") == ("free", "free_births")
    assert {*fields_of("anchor", "free", "camera", "shared")} == {row.name for row in STATE_TABLE}
    assert [p.name for p in parameters_of(["camera_color", "environment"])] == [
        "camera_gains",
        "camera_biases",
        "environment",
    ]


def test_a_dynamic_field_that_nothing_begins_is_refused() -> None:
    scene = random_scene()
    assert with_dynamic_fields(scene, PAPER_DYNAMIC) is scene
    for name in ("appearance", "environment"):
        with pytest.raises(ConfigError, match=f"dynamic set has {name}, which the scene lacks"):
            with_dynamic_fields(scene, {*PAPER_DYNAMIC, name})


def test_the_papers_lifetimes() -> None:
    """Section Structured 3DGs: x_v, l_v and F_Sigma change after frame 0, O_v, f_v, F_alpha and F_c do not."""
    assert {"anchor_positions", "offset_scales", "covariance_mlp", "free", "free_births"} == PAPER_DYNAMIC


def test_size_of_the_covariance_mlp() -> None:
    """36 inputs, 32 hidden units, 7 numbers for each of 5 Gaussians: 2,339 weights."""
    state = state_of(random_scene(free=3))
    assert state["covariance_mlp"].numel() == 32 * 36 + 32 + 35 * 32 + 35 == 2339
    assert state["free"].shape == (3, FREE_COLUMNS)

# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import torch

from rigs import random_scene
from structgstream.scene.appearance import with_appearance
from structgstream.scene.state import FREE_COLUMNS, PAPER_DYNAMIC, STATE_TABLE, scene_of, state_of


def test_state_and_scene_are_inverse() -> None:
    scene = random_scene(free=4)
    state = state_of(scene)
    again = state_of(scene_of(state, distance_input=True))
    assert set(state) == {f.name for f in STATE_TABLE if not f.optional}
    for name, value in state.items():
        assert torch.equal(again[name], value), name


def test_codes_are_never_shared() -> None:
    codes = [f.code for f in STATE_TABLE]
    assert len(set(codes)) == len(codes)


def test_the_papers_lifetimes() -> None:
    """Section Structured 3DGs: x_v, l_v and F_Sigma change after frame 0, O_v, f_v, F_alpha and F_c do not."""
    assert {"anchor_positions", "offset_scales", "covariance_mlp", "free", "free_births"} == PAPER_DYNAMIC


def test_size_of_the_covariance_mlp() -> None:
    """36 inputs, 32 hidden units, 7 numbers for each of 5 Gaussians: 2,339 weights."""
    state = state_of(random_scene(free=3))
    assert state["covariance_mlp"].numel() == 32 * 36 + 32 + 35 * 32 + 35 == 2339
    assert state["free"].shape == (3, FREE_COLUMNS)


def test_appearance_and_environment_are_in_the_state_of_scenes_that_have_them() -> None:
    scene = replace(with_appearance(random_scene(free=4), 3), environment=torch.rand(9, 3))
    state = state_of(scene)
    assert set(state) == {f.name for f in STATE_TABLE}
    assert state["appearance"].shape == (len(scene.anchors), 3)
    again = state_of(scene_of(state, distance_input=True))
    for name, value in state.items():
        assert torch.equal(again[name], value), name

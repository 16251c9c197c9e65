# SPDX-License-Identifier: Apache-2.0
import torch

from structgstream.scene.state import PAPER_DYNAMIC, state_of
from structgstream.training.parameters import FREE_ROWS, Parameters, detached, parameters_of_fields
from tests.support.rigs import random_scene
from tests.support.streams import same


def test_taking_apart_and_putting_together_changes_no_bit() -> None:
    scene = random_scene(free=6)
    assert same(detached(Parameters.of(scene, trained=parameters_of_fields(PAPER_DYNAMIC)).scene(scene)), scene)


def test_the_dynamic_fields_name_what_is_trained() -> None:
    names = {"anchor_positions", "offset_scales", "covariance_mlp", *FREE_ROWS}
    assert parameters_of_fields(PAPER_DYNAMIC) == names


def test_parameters_are_copies() -> None:
    scene = random_scene(free=2)
    parameters = Parameters.of(scene, trained=frozenset())
    for value in parameters.values.values():
        value.add_(1.0)
    assert torch.equal(scene.anchors.positions, random_scene(free=2).anchors.positions)


def test_detached_scenes_carry_no_graph() -> None:
    scene = random_scene(free=2)
    parameters = Parameters.of(scene, trained=parameters_of_fields(PAPER_DYNAMIC))
    assert not any(value.requires_grad for value in state_of(detached(parameters.scene(scene))).values())

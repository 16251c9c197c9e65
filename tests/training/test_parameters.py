# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import torch

from structgstream.scene.color import CameraColor
from structgstream.scene.state import PAPER_DYNAMIC, state_of
from structgstream.training.parameters import FREE_ROWS, Parameters, detached, parameters_of_fields
from tests.support.rigs import random_scene


def test_taking_apart_and_putting_together_changes_no_bit() -> None:
    scene = random_scene(free=6)
    again = Parameters.of(scene, trained=parameters_of_fields(PAPER_DYNAMIC)).scene(scene)
    for name, value in state_of(scene).items():
        assert torch.equal(state_of(again)[name], value), name


def test_the_dynamic_fields_name_what_is_trained() -> None:
    names = {"anchor_positions", "offset_scales", "covariance_mlp", *FREE_ROWS}
    assert parameters_of_fields(PAPER_DYNAMIC) == names


def test_parameters_are_copies() -> None:
    scene = random_scene(free=2)
    parameters = Parameters.of(scene, trained=frozenset())
    for value in parameters.values.values():
        value.add_(1.0)
    assert torch.equal(scene.anchors.positions, random_scene(free=2).anchors.positions)


def test_the_gauge_holds_while_colour_is_trained() -> None:
    color = CameraColor(gains=torch.rand(3, 3) + 1.0, biases=torch.rand(3, 3))
    scene = replace(random_scene(), camera_color=color)
    gauged = Parameters.of(scene, trained=frozenset({"camera_gains", "camera_biases"})).scene(scene).camera_color
    assert torch.allclose(gauged.gains.mean(0), torch.ones(3))
    assert torch.allclose(gauged.biases.mean(0), torch.zeros(3), atol=1e-6)


def test_detached_scenes_carry_no_graph() -> None:
    scene = random_scene(free=2)
    parameters = Parameters.of(scene, trained=parameters_of_fields(PAPER_DYNAMIC))
    assert not any(value.requires_grad for value in state_of(detached(parameters.scene(scene))).values())

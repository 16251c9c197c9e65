# SPDX-License-Identifier: Apache-2.0
import pytest
import torch

from structgstream.kernels.backend import reference_backend
from structgstream.training.optim import BETAS, EPS, Adam, LearningRate, constant, leaves
from structgstream.training.parameters import Parameters
from tests.support.rigs import random_scene


def test_rates_are_log_linear() -> None:
    rate = LearningRate(1e-2, 1e-4)
    assert rate.at(0.0) == pytest.approx(1e-2)
    assert rate.at(0.5) == pytest.approx(1e-3)
    assert rate.at(2.0) == pytest.approx(1e-4)
    assert constant(0.3).at(0.7) == 0.3
    assert constant(0.0).at(0.5) == 0.0


def test_steps_are_those_of_torch() -> None:
    scene = random_scene(7)
    parameters = Parameters.of(scene, trained=frozenset({"anchor_positions", "anchor_offsets"}))
    twin = parameters.values["anchor_positions"].detach().clone().requires_grad_()
    theirs = torch.optim.Adam([twin], lr=1e-2, betas=BETAS, eps=EPS)
    ours = Adam(reference_backend(), parameters.values)
    for _ in range(5):
        gradient = torch.randn_like(twin) * 1e-6
        twin.grad = gradient.clone()
        theirs.step()
        ours.step({"anchor_positions": gradient}, {"anchor_positions": 1e-2})
    assert torch.allclose(parameters.values["anchor_positions"], twin, atol=1e-6)
    assert torch.equal(parameters.values["anchor_offsets"], scene.anchors.offsets)


def test_rows_come_and_go_with_their_state() -> None:
    scene = random_scene(4)
    parameters = Parameters.of(scene, trained=frozenset({"anchor_positions"}))
    adam = Adam(reference_backend(), parameters.values)
    adam.step({"anchor_positions": torch.ones(4, 3)}, {"anchor_positions": 0.1})
    keep = torch.tensor([True, False, True, True])
    before = adam.first["anchor_positions"].clone()
    kept = parameters.values["anchor_positions"].detach()[keep]
    adam.replace_rows({"anchor_positions": torch.full((2, 3), 7.0)}, keep=keep)
    assert torch.equal(parameters.values["anchor_positions"], torch.cat([kept, torch.full((2, 3), 7.0)]))
    assert parameters.values["anchor_positions"].requires_grad
    assert torch.equal(adam.first["anchor_positions"], torch.cat([before[keep], torch.zeros(2, 3)]))


def test_a_rate_of_zero_moves_nothing() -> None:
    parameters = Parameters.of(random_scene(3), trained=frozenset({"anchor_positions"}))
    before = parameters.values["anchor_positions"].detach().clone()
    Adam(reference_backend(), parameters.values).step({"anchor_positions": torch.ones(3, 3)}, {"anchor_positions": 0.0})
    assert torch.equal(parameters.values["anchor_positions"], before)


def test_leaves_are_copies() -> None:
    value = torch.zeros(3)
    leaf = leaves({"x": value})["x"]
    assert leaf.requires_grad
    leaf.detach().add_(1.0)
    assert not value.any()

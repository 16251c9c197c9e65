# SPDX-License-Identifier: Apache-2.0
"""The rate term of the loss."""

import pytest
import torch

from structgstream.codec.fields.quantization import RateTerm
from structgstream.kernels.backend import reference_backend
from structgstream.training.parameters import Parameters, parameters_of_fields
from tests.support.rigs import random_scene

BACKEND = reference_backend()


def test_leaving_a_bin_has_a_price() -> None:
    parameters = Parameters.of(random_scene(10), trained=parameters_of_fields({"anchor_positions", "offset_scales"}))
    steps = {"anchor_positions": 0.5, "offset_scales": 0.25, "covariance_mlp": 0.1}
    rate_term = RateTerm.of(parameters.values, steps, weight=0.5, free=False)  # type: ignore[arg-type]
    assert rate_term is not None
    assert rate_term.value(parameters.values, BACKEND).item() == 0.0
    values = dict(parameters.values)
    values["anchor_positions"] = values["anchor_positions"].detach().clone()
    values["anchor_positions"][2, 1] -= 0.5
    values["offset_scales"] = values["offset_scales"].detach().clone()
    values["offset_scales"][7, 0] += 0.75
    assert rate_term.value(values, BACKEND).item() == pytest.approx(0.5 * (1.0 + 2.0) / 8000, rel=1e-4)
    positions = parameters.values["anchor_positions"]
    price = rate_term.value({**parameters.values, "anchor_positions": positions + 0.1}, BACKEND)
    (gradient,) = torch.autograd.grad(price, [positions])
    assert (gradient > 0).all(), "it pulls back"


def test_what_was_there_is_charged_and_what_is_spawned_is_not() -> None:
    scene = random_scene(10, free=6)
    parameters = Parameters.of(scene, trained=parameters_of_fields({"free"}))
    steps: dict = {"free_means": 0.5, "free_colors": 0.1}
    assert RateTerm.of(parameters.values, steps, weight=1.0, free=False) is None
    rate_term = RateTerm.of(parameters.values, steps, weight=1.0, free=True)
    assert rate_term is not None
    keep = torch.tensor([True, False, True, True, False, True])
    rate_term, old = rate_term.after_pruning(keep), parameters.values["free_means"]
    values: dict = {name: value.detach()[keep] for name, value in parameters.values.items() if name in steps}
    values["free_means"] = torch.cat([values["free_means"], old[:3].detach() + 7.0])
    values["free_colors"] = torch.cat([values["free_colors"], values["free_colors"][:3]])
    assert rate_term.value(values, BACKEND).item() == 0.0
    values["free_means"][2, 1] += 1.5  # Two bits.
    assert rate_term.value(values, BACKEND).item() == pytest.approx(2.0 / 8000, rel=1e-4)


@pytest.mark.parametrize(("steps", "weight"), [({}, 1.0), ({"covariance_mlp": 0.1}, 1.0), ({"base_scales": 0.1}, 0.0)])
def test_no_price_where_nothing_is_paid(steps: dict, weight: float) -> None:
    parameters = Parameters.of(random_scene(3), trained=parameters_of_fields({"anchor_positions"}))
    assert RateTerm.of(parameters.values, steps, weight=weight, free=True) is None

# SPDX-License-Identifier: Apache-2.0
"""Colours by direction and rotations against closed forms."""

import math

import pytest
import torch

from structgstream.harmonics import Y0, sh_basis
from structgstream_studies.peers.plain import PlainGaussians, composed, moved, rotated


def directions(count: int, seed: int = 0) -> torch.Tensor:
    g = torch.Generator().manual_seed(seed)
    return torch.nn.functional.normalize(torch.randn(count, 3, generator=g, dtype=torch.float64), dim=1)


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_colours_are_half_plus_the_sum_and_not_negative(degree: int) -> None:
    count, coefficients = 30, (degree + 1) ** 2 - 1
    g = torch.Generator().manual_seed(1)
    plain = PlainGaussians(
        means=directions(count).float() * 3 + 1.0,
        log_scales=torch.zeros(count, 3),
        quats=torch.randn(count, 4, generator=g),
        logit_opacities=torch.zeros(count),
        base_colors=torch.randn(count, 3, generator=g),
        sh=torch.randn(count, coefficients, 3, generator=g),
    )
    center = torch.tensor([0.3, -0.2, 5.0])
    found = plain.colors(center)
    for row in range(count):
        direction = torch.nn.functional.normalize((plain.means[row] - center)[None], dim=1)
        expected = 0.5 + plain.base_colors[row] * Y0
        for i in range(coefficients):
            expected = expected + sh_basis(direction, degree)[0, 1 + i] * plain.sh[row, i]
        torch.testing.assert_close(found[row], expected.clamp(min=0))
    assert (found == 0).any()
    torch.testing.assert_close(plain.colors(center, degree=0), (0.5 + Y0 * plain.base_colors).clamp(min=0))


def test_rotations_follow_one_another() -> None:
    g = torch.Generator().manual_seed(2)
    first, second = (torch.randn(20, 4, generator=g, dtype=torch.float64) for _ in range(2))
    vectors = torch.randn(20, 3, generator=g, dtype=torch.float64)
    torch.testing.assert_close(rotated(composed(first, second), vectors), rotated(first, rotated(second, vectors)))


def test_a_quarter_turn_about_z_turns_x_to_y() -> None:
    quarter = torch.tensor([[math.cos(math.pi / 4), 0.0, 0.0, math.sin(math.pi / 4)]])
    torch.testing.assert_close(rotated(quarter, torch.tensor([[1.0, 0, 0]])), torch.tensor([[0, 1.0, 0]]))


def test_moving_changes_means_and_rotations_alone() -> None:
    empty = PlainGaussians.empty(1, torch.zeros(0))
    one = PlainGaussians(**{name: torch.ones(1, *value.shape[1:]) for name, value in empty.tensors().items()})
    turned = moved(one, torch.tensor([[1.0, 2.0, 3.0]]), torch.tensor([[2.0, 0.0, 0.0, 0.0]]))
    torch.testing.assert_close(turned.means, torch.tensor([[2.0, 3.0, 4.0]]))
    torch.testing.assert_close(turned.quats, torch.full((1, 4), 0.5))
    assert turned.sh is one.sh
    assert turned.log_scales is one.log_scales

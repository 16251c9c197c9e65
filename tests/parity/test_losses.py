# SPDX-License-Identifier: Apache-2.0
"""Sums of losses in C++ beside the oracle in float64."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from structgstream.errors import BackendError
from structgstream.kernels import cpu_losses, reference_losses
from tests.support.backends import needs_native

pytestmark = needs_native


def compared(
    loss: Callable[..., Tensor], *leaves: Tensor, within: float = 1e-5
) -> tuple[Tensor, list[tuple[Tensor, Tensor]]]:
    """``loss(module, dtype, leaves)`` of the oracle, and pairs of gradients, after a check that C++ agrees with it."""
    found = []
    for module, dtype in ((cpu_losses, torch.float32), (reference_losses, torch.float64)):
        given = [leaf.to(dtype).requires_grad_() for leaf in leaves]
        total = loss(module, dtype, given)
        found.append((total, torch.autograd.grad(3.0 * total, given)))
    (total, gradients), (exact, exact_gradients) = found
    assert total.shape == exact.shape == ()
    assert abs(total - exact) <= within * exact
    pairs = list(zip(gradients, exact_gradients, strict=True))
    assert all((gradient - wanted).norm() <= within * wanted.norm() for gradient, wanted in pairs)
    return exact, pairs


@pytest.mark.parametrize("count", [0, 1, 1001])
def test_volume(count: int) -> None:
    g = torch.Generator().manual_seed(1)
    scales, opacities = torch.rand(count, 3, generator=g), torch.rand(count, generator=g) - 0.3
    compared(lambda module, dtype, given: module.volume(*given, opacities.to(dtype))[0], scales, within=1e-6)
    assert cpu_losses.volume(scales, opacities)[1] == reference_losses.volume(scales, opacities)[1]


@pytest.mark.parametrize("count", [0, 1, 1001])
def test_excess(count: int) -> None:
    g = torch.Generator().manual_seed(1)
    offsets, log_scales = torch.randn(count, 5, 3, generator=g), torch.randn(count, 3, generator=g) * 0.3 - 4.5
    # A float32 sum of fifteen, then float64.
    exact, _ = compared(lambda module, dtype, given: module.excess(*given, 0.0134), offsets, log_scales)
    assert count < 2 or exact > 0


@pytest.mark.parametrize(("count", "each"), [(2, 1), (7, 6), (1001, 8)])
def test_neighbour_difference(count: int, each: int) -> None:
    g = torch.Generator().manual_seed(1)
    values, shares = torch.randn(count, 3, generator=g), torch.rand(count, each, generator=g)
    neighbours = torch.randint(0, count, (count, each), generator=g)

    def difference(module: Any, dtype: torch.dtype, given: list[Tensor]) -> Tensor:
        return module.neighbour_difference(*given, neighbours, shares.to(dtype), slack=0.25)

    assert compared(difference, values)[0] > 0


@pytest.mark.parametrize("rows", [0, 1, 7, 16, 500, 4001])
def test_change_bits(isa: int, rows: int) -> None:
    g = torch.Generator().manual_seed(1)
    before = [torch.randn(rows, width, generator=g) for width in (3, 5, 1)]
    steps = [0.25, 1e-3, 7.0]
    values = [old + torch.randn(old.shape, generator=g) * (torch.rand(old.shape, generator=g) < 0.4) for old in before]

    def bits(module: Any, dtype: torch.dtype, given: list[Tensor]) -> Tensor:
        return module.change_bits(given, [old.to(dtype) for old in before], steps)

    for gradient, exact_gradient in compared(bits, *values)[1]:
        assert torch.equal(gradient == 0.0, exact_gradient == 0.0), "what has not changed has no gradient"


def test_another_precision_is_refused() -> None:
    rows, pairs = torch.rand(2, 3).double(), torch.tensor([[1], [0]])
    for call in (
        lambda: cpu_losses.volume(rows, rows[:, 0]),
        lambda: cpu_losses.excess(torch.rand(2, 5, 3).double(), rows, 0.1),
        lambda: cpu_losses.neighbour_difference(rows, pairs, torch.ones(2, 1).double(), slack=0.25),
        lambda: cpu_losses.change_bits([rows], [rows], [0.1]),
    ):
        with pytest.raises(BackendError, match="float64"):
            call()

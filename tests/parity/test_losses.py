# SPDX-License-Identifier: Apache-2.0
"""Sums of losses in C++ beside the oracle in float64."""

import pytest
import torch

from structgstream.errors import BackendError
from structgstream.kernels import cpu_losses, reference_losses
from structgstream.kernels.native import native_reason

pytestmark = pytest.mark.skipif(native_reason() is not None, reason=str(native_reason()))


@pytest.mark.parametrize("count", [0, 1, 1001])
def test_volume(count: int) -> None:
    g = torch.Generator().manual_seed(1)
    scales, opacities = torch.rand(count, 3, generator=g), torch.rand(count, generator=g) - 0.3
    found = []
    for module, dtype in ((cpu_losses, torch.float32), (reference_losses, torch.float64)):
        given = scales.to(dtype).requires_grad_()
        total, drawn = module.volume(given, opacities.to(dtype))
        found.append((total, drawn, *torch.autograd.grad(3.0 * total, given)))
    (total, drawn, gradient), (exact, exact_drawn, exact_gradient) = found
    assert abs(total - exact) <= 1e-6 * exact
    assert drawn == exact_drawn
    assert (gradient - exact_gradient).norm() <= 1e-6 * exact_gradient.norm()


@pytest.mark.parametrize("count", [0, 1, 1001])
def test_excess(count: int) -> None:
    g = torch.Generator().manual_seed(1)
    offsets, log_scales = torch.randn(count, 5, 3, generator=g), torch.randn(count, 3, generator=g) * 0.3 - 4.5
    found = []
    for module, dtype in ((cpu_losses, torch.float32), (reference_losses, torch.float64)):
        given = [offsets.to(dtype).requires_grad_(), log_scales.to(dtype).requires_grad_()]
        total = module.excess(*given, 0.0134)
        found.append((total, *torch.autograd.grad(3.0 * total, given)))
    (total, *gradients), (exact, *exact_gradients) = found
    assert abs(total - exact) <= 1e-5 * exact  # a float32 sum of fifteen, then float64
    for gradient, exact_gradient in zip(gradients, exact_gradients, strict=True):
        assert (gradient - exact_gradient).norm() <= 1e-5 * exact_gradient.norm()
    assert count < 2 or exact > 0


@pytest.mark.parametrize(("count", "each"), [(2, 1), (7, 6), (1001, 8)])
def test_neighbour_difference(count: int, each: int) -> None:
    g = torch.Generator().manual_seed(1)
    values, shares = torch.randn(count, 3, generator=g), torch.rand(count, each, generator=g)
    neighbours = torch.randint(0, count, (count, each), generator=g)
    found = []
    for module, dtype in ((cpu_losses, torch.float32), (reference_losses, torch.float64)):
        given = values.to(dtype).requires_grad_()
        total = module.neighbour_difference(given, neighbours, shares.to(dtype), slack=0.25)
        found.append((total, *torch.autograd.grad(3.0 * total, [given])))
    (total, gradient), (exact, exact_gradient) = found
    assert exact > 0
    assert abs(total - exact) <= 1e-5 * exact
    assert (gradient - exact_gradient).norm() <= 1e-5 * exact_gradient.norm()


@pytest.mark.parametrize("rows", [0, 1, 7, 16, 500, 4001])
def test_change_bits(isa: int, rows: int) -> None:
    g = torch.Generator().manual_seed(1)
    before = [torch.randn(rows, width, generator=g) for width in (3, 5, 1)]
    steps = [0.25, 1e-3, 7.0]
    values = [old + torch.randn(old.shape, generator=g) * (torch.rand(old.shape, generator=g) < 0.4) for old in before]
    found = []
    for module, dtype in ((cpu_losses, torch.float32), (reference_losses, torch.float64)):
        given = [value.to(dtype).requires_grad_() for value in values]
        total = module.change_bits(given, [old.to(dtype) for old in before], steps)
        found.append((total, *torch.autograd.grad(3.0 * total, given)))
    (total, *gradients), (exact, *exact_gradients) = found
    assert total.shape == exact.shape == ()
    assert abs(total - exact) <= 1e-5 * exact
    for gradient, exact_gradient in zip(gradients, exact_gradients, strict=True):
        assert (gradient - exact_gradient).norm() <= 1e-5 * exact_gradient.norm()
        assert torch.equal(gradient == 0.0, exact_gradient == 0.0), "what has not changed has no gradient"


def test_another_precision_is_refused() -> None:
    rows, pairs = torch.rand(2, 3).double(), torch.tensor([[1], [0]])
    with pytest.raises(BackendError, match="float64"):
        cpu_losses.volume(rows, rows[:, 0])
    with pytest.raises(BackendError, match="float64"):
        cpu_losses.excess(torch.rand(2, 5, 3).double(), rows, 0.1)
    with pytest.raises(BackendError, match="float64"):
        cpu_losses.neighbour_difference(rows, pairs, torch.ones(2, 1).double(), slack=0.25)
    with pytest.raises(BackendError, match="float64"):
        cpu_losses.change_bits([rows], [rows], [0.1])

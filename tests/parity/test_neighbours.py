# SPDX-License-Identifier: Apache-2.0
"""Differences from neighbours in C++ beside the oracle in float64."""

import pytest
import torch

from structgstream.errors import BackendError
from structgstream.kernels import cpu_neighbours, reference_neighbours
from structgstream.kernels._load import native_reason

pytestmark = pytest.mark.skipif(native_reason() is not None, reason=str(native_reason()))


@pytest.mark.parametrize(("count", "each"), [(2, 1), (7, 6), (1001, 8)])
def test_sum_and_gradient(count: int, each: int) -> None:
    g = torch.Generator().manual_seed(1)
    values, shares = torch.randn(count, 3, generator=g), torch.rand(count, each, generator=g)
    neighbours = torch.randint(0, count, (count, each), generator=g)
    found = []
    for module, dtype in ((cpu_neighbours, torch.float32), (reference_neighbours, torch.float64)):
        given = values.to(dtype).requires_grad_()
        total = module.neighbour_difference(given, neighbours, shares.to(dtype), slack=0.25)
        found.append((total, *torch.autograd.grad(3.0 * total, [given])))
    (total, gradient), (exact, exact_gradient) = found
    assert exact > 0
    assert abs(total - exact) <= 1e-5 * exact
    assert (gradient - exact_gradient).norm() <= 1e-5 * exact_gradient.norm()


def test_another_precision_is_refused() -> None:
    with pytest.raises(BackendError, match="float64"):
        cpu_neighbours.neighbour_difference(
            torch.rand(2, 3).double(), torch.tensor([[1], [0]]), torch.ones(2, 1).double(), slack=0.25
        )

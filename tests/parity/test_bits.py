# SPDX-License-Identifier: Apache-2.0
"""Bits of changes in C++ beside the oracle in float64."""

import pytest
import torch

from structgstream.errors import BackendError
from structgstream.kernels import cpu_bits, reference_bits
from structgstream.kernels._load import native_reason

pytestmark = pytest.mark.skipif(native_reason() is not None, reason=str(native_reason()))


@pytest.mark.parametrize("rows", [0, 1, 7, 16, 500, 4001])
def test_sum_and_gradient(isa: int, rows: int) -> None:
    g = torch.Generator().manual_seed(1)
    before = [torch.randn(rows, width, generator=g) for width in (3, 5, 1)]
    steps = [0.25, 1e-3, 7.0]
    values = [old + torch.randn(old.shape, generator=g) * (torch.rand(old.shape, generator=g) < 0.4) for old in before]
    found = []
    for module, dtype in ((cpu_bits, torch.float32), (reference_bits, torch.float64)):
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
    with pytest.raises(BackendError, match="float64"):
        cpu_bits.change_bits([torch.rand(2).double()], [torch.rand(2).double()], [0.1])

# SPDX-License-Identifier: Apache-2.0
"""What strays from anchors in C++ beside the oracle in float64."""

import pytest
import torch

from structgstream.errors import BackendError
from structgstream.kernels import cpu_excess, reference_excess
from structgstream.kernels._load import native_reason

pytestmark = pytest.mark.skipif(native_reason() is not None, reason=str(native_reason()))


@pytest.mark.parametrize("count", [0, 1, 1001])
def test_sum_and_gradients(count: int) -> None:
    g = torch.Generator().manual_seed(1)
    offsets, log_scales = torch.randn(count, 5, 3, generator=g), torch.randn(count, 3, generator=g) * 0.3 - 4.5
    found = []
    for module, dtype in ((cpu_excess, torch.float32), (reference_excess, torch.float64)):
        given = [offsets.to(dtype).requires_grad_(), log_scales.to(dtype).requires_grad_()]
        total = module.excess(*given, 0.0134)
        found.append((total, *torch.autograd.grad(3.0 * total, given)))
    (total, *gradients), (exact, *exact_gradients) = found
    assert abs(total - exact) <= 1e-5 * exact  # a float32 sum of fifteen, then float64
    for gradient, exact_gradient in zip(gradients, exact_gradients, strict=True):
        assert (gradient - exact_gradient).norm() <= 1e-5 * exact_gradient.norm()
    assert count < 2 or exact > 0


def test_another_precision_is_refused() -> None:
    with pytest.raises(BackendError, match="float64"):
        cpu_excess.excess(torch.rand(2, 5, 3).double(), torch.rand(2, 3).double(), 0.1)

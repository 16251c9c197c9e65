# SPDX-License-Identifier: Apache-2.0
"""Volumes in C++ beside the oracle in float64."""

import pytest
import torch

from structgstream.errors import BackendError
from structgstream.kernels import cpu_volume, reference_volume
from structgstream.kernels._load import native_reason

pytestmark = pytest.mark.skipif(native_reason() is not None, reason=str(native_reason()))


@pytest.mark.parametrize("count", [0, 1, 1001])
def test_sum_count_and_gradient(count: int) -> None:
    g = torch.Generator().manual_seed(1)
    scales, opacities = torch.rand(count, 3, generator=g), torch.rand(count, generator=g) - 0.3
    found = []
    for module, dtype in ((cpu_volume, torch.float32), (reference_volume, torch.float64)):
        given = scales.to(dtype).requires_grad_()
        total, drawn = module.volume(given, opacities.to(dtype))
        found.append((total, drawn, *torch.autograd.grad(3.0 * total, given)))
    (total, drawn, gradient), (exact, exact_drawn, exact_gradient) = found
    assert abs(total - exact) <= 1e-6 * exact
    assert drawn == exact_drawn
    assert (gradient - exact_gradient).norm() <= 1e-6 * exact_gradient.norm()


def test_another_precision_is_refused() -> None:
    with pytest.raises(BackendError, match="float64"):
        cpu_volume.volume(torch.rand(2, 3).double(), torch.rand(2).double())

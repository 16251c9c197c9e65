# SPDX-License-Identifier: Apache-2.0
"""The C++ optimiser step beside its oracle."""

import pytest
import torch

from structgstream.errors import BackendError
from structgstream.kernels import cpu_losses, reference_losses
from structgstream.kernels.native import native_reason
from tests.support.adam_steps import OPTIONS, steps

pytestmark = pytest.mark.skipif(native_reason() is not None, reason=str(native_reason()))


@pytest.mark.parametrize("shape", [(1,), (7, 3), (50, 5, 3), (9001, 4)])
def test_steps(isa: int, shape: tuple[int, ...]) -> None:
    param = torch.randn(shape)
    # Gradients of a mean over pixels are tiny, and those of unseen rows are zero.
    gradients = [torch.randn(shape) * 1e-6 * (torch.rand(shape) < 0.8) for _ in range(10)]
    ours, exact = steps(cpu_losses, param, gradients), steps(reference_losses, param.double(), gradients)
    assert torch.allclose(ours[0].double(), exact[0], rtol=1e-6, atol=1e-6)
    for moment, wanted in zip(ours[1:], exact[1:], strict=True):
        assert (moment.double() - wanted).norm() <= 1e-6 * wanted.norm()


def test_bitwise_equal_for_any_number_of_threads(isa: int) -> None:
    param = torch.randn(30_000, 3)
    gradients = [torch.randn(30_000, 3) for _ in range(2)]
    results = []
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        results.append(steps(cpu_losses, param, gradients))
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_nothing_to_move() -> None:
    assert steps(cpu_losses, torch.zeros(0, 3), [torch.zeros(0, 3)])[0].shape == (0, 3)


def test_what_it_cannot_step() -> None:
    param = torch.zeros(4, 3)
    with pytest.raises(BackendError, match="float64"):
        steps(cpu_losses, param.double(), [param.double()])
    with pytest.raises(BackendError, match="contiguous"):
        cpu_losses.adam_step(torch.zeros(3, 4).T, param, param.clone(), param.clone(), step=1, **OPTIONS)

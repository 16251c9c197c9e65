# SPDX-License-Identifier: Apache-2.0
"""torch's fused optimiser step beside the oracle; the same operation runs on the processor and on a GPU."""

import pytest
import torch

from structgstream.kernels import cuda, reference_losses
from tests.support.adam_steps import OPTIONS, steps

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.needs_cuda)]


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("shape", [(), (1,), (7, 3), (50, 5, 3), (9001, 4)])
def test_steps(device: str, shape: tuple[int, ...]) -> None:
    param = torch.randn(shape, device=device)
    # Gradients of a mean over pixels are tiny, and those of unseen rows are zero.
    gradients = [torch.randn_like(param) * 1e-6 * (torch.rand_like(param) < 0.8) for _ in range(10)]
    ours, exact = steps(cuda, param, gradients), steps(reference_losses, param.double(), gradients)
    assert torch.allclose(ours[0].double(), exact[0], rtol=1e-6, atol=1e-6)
    # On a GPU torch takes 1 - beta in float32, which for the second moment is 1.3e-5 too little.
    for moment, wanted, tolerance in zip(ours[1:], exact[1:], (1e-6, 1e-6 if device == "cpu" else 2e-5), strict=True):
        assert (moment.double() - wanted).norm() <= tolerance * wanted.norm()


@pytest.mark.parametrize("device", DEVICES)
def test_a_gradient_laid_out_otherwise(device: str) -> None:
    param, gradient = torch.randn(6, 4, device=device), torch.randn(4, 6, device=device).T
    ours, exact = steps(cuda, param, [gradient]), steps(reference_losses, param.double(), [gradient])
    assert torch.allclose(ours[0].double(), exact[0], rtol=1e-6, atol=1e-6)


def test_nothing_to_move() -> None:
    assert steps(cuda, torch.zeros(0, 3), [torch.zeros(0, 3)])[0].shape == (0, 3)


@pytest.mark.needs_cuda
def test_nothing_waits_for_the_gpu() -> None:
    param = torch.randn(100, 3, device="cuda")
    state = [param, torch.randn_like(param), torch.zeros_like(param), torch.zeros_like(param)]
    torch.cuda.set_sync_debug_mode("error")
    try:
        cuda.adam_step(*state, step=1, **OPTIONS)
    finally:
        torch.cuda.set_sync_debug_mode("default")

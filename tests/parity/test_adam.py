# SPDX-License-Identifier: Apache-2.0
"""The optimiser step in C++ and torch's fused one beside the oracle; the fused one also runs on the processor."""

from collections.abc import Iterator
from types import ModuleType

import pytest
import torch
from torch import Tensor

from structgstream.errors import BackendError
from structgstream.kernels import cpu_losses, cuda, reference_losses
from structgstream.kernels.native import ISA_NAMES
from tests.parity.conftest import check_any_threads, using_isa

OPTIONS = {"lr": 0.01, "betas": (0.9, 0.999), "eps": 1e-15}


def steps(module: ModuleType, param: Tensor, gradients: list[Tensor]) -> list[Tensor]:
    """The parameter and both moments after a step of ``module.adam_step`` for each gradient."""
    state = [param.clone(), torch.zeros_like(param), torch.zeros_like(param)]
    for n, gradient in enumerate(gradients, start=1):
        module.adam_step(state[0], gradient.to(param), state[1], state[2], step=n, **OPTIONS)
    return state


@pytest.fixture(params=[*ISA_NAMES, "fused", pytest.param("cuda", marks=pytest.mark.needs_cuda)])
def stepping(request: pytest.FixtureRequest) -> Iterator[tuple[ModuleType, str]]:
    """A module with ``adam_step``, and the type of its device."""
    if request.param not in ISA_NAMES:
        yield cuda, "cuda" if request.param == "cuda" else "cpu"
        return
    with using_isa(ISA_NAMES.index(request.param)):
        yield cpu_losses, "cpu"


@pytest.mark.parametrize("shape", [(), (1,), (7, 3), (50, 5, 3), (9001, 4)])
def test_steps(stepping: tuple[ModuleType, str], shape: tuple[int, ...]) -> None:
    module, device = stepping
    param = torch.randn(shape, device=device)
    # Gradients of a mean over pixels are tiny, and those of unseen rows are zero.
    gradients = [torch.randn_like(param) * 1e-6 * (torch.rand_like(param) < 0.8) for _ in range(10)]
    ours, exact = steps(module, param, gradients), steps(reference_losses, param.double(), gradients)
    assert torch.allclose(ours[0].double(), exact[0], rtol=1e-6, atol=1e-6)
    # On a GPU torch takes 1 - beta in float32, which for the second moment is 1.3e-5 too little.
    for moment, wanted, tolerance in zip(ours[1:], exact[1:], (1e-6, 1e-6 if device == "cpu" else 2e-5), strict=True):
        assert (moment.double() - wanted).norm() <= tolerance * wanted.norm()


def test_a_gradient_laid_out_otherwise(stepping: tuple[ModuleType, str]) -> None:
    module, device = stepping
    param, gradient = torch.randn(6, 4, device=device), torch.randn(4, 6, device=device).T
    ours, exact = steps(module, param, [gradient]), steps(reference_losses, param.double(), [gradient])
    assert torch.allclose(ours[0].double(), exact[0], rtol=1e-6, atol=1e-6)


def test_nothing_to_move(stepping: tuple[ModuleType, str]) -> None:
    module, device = stepping
    nothing = torch.zeros(0, 3, device=device)
    assert steps(module, nothing, [nothing])[0].shape == (0, 3)


def test_bitwise_equal_for_any_number_of_threads(isa: int) -> None:
    param = torch.randn(30_000, 3)
    gradients = [torch.randn(30_000, 3) for _ in range(2)]
    check_any_threads(lambda: steps(cpu_losses, param, gradients))


def test_what_it_cannot_step() -> None:
    param = torch.zeros(4, 3)
    with pytest.raises(BackendError, match="float64"):
        steps(cpu_losses, param.double(), [param.double()])
    with pytest.raises(BackendError, match="contiguous"):
        cpu_losses.adam_step(torch.zeros(3, 4).T, param, param.clone(), param.clone(), step=1, **OPTIONS)


@pytest.mark.needs_cuda
def test_nothing_waits_for_the_gpu() -> None:
    param = torch.randn(100, 3, device="cuda")
    state = [param, torch.randn_like(param), torch.zeros_like(param), torch.zeros_like(param)]
    torch.cuda.set_sync_debug_mode("error")
    try:
        cuda.adam_step(*state, step=1, **OPTIONS)
    finally:
        torch.cuda.set_sync_debug_mode("default")

# SPDX-License-Identifier: Apache-2.0
import torch

from structgstream.kernels.reference_adam import adam_step

OPTIONS = {"lr": 0.01, "betas": (0.9, 0.999), "eps": 1e-15}


def test_steps_as_torch() -> None:
    param = torch.randn(4, 3)
    twin = param.clone().requires_grad_()
    theirs = torch.optim.Adam([twin], lr=0.01, betas=(0.9, 0.999), eps=1e-15)
    first, second = torch.zeros(4, 3), torch.zeros(4, 3)
    for step in range(1, 6):
        grad = torch.randn(4, 3)
        twin.grad = grad.clone()
        theirs.step()
        adam_step(param, grad, first, second, step=step, **OPTIONS)
    assert torch.allclose(param, twin, atol=1e-6)

# SPDX-License-Identifier: Apache-2.0
"""Adam in torch's fused kernel, one launch per tensor; the contract is ``kernels.operations.AdamStep``."""

import torch
from torch import Tensor


def adam_step(
    param: Tensor,
    grad: Tensor,
    exp_avg: Tensor,
    exp_avg_sq: Tensor,
    *,
    lr: float | Tensor,
    step: int | Tensor,
    betas: tuple[float, float],
    eps: float,
) -> None:
    """See ``kernels.operations.AdamStep``; without host synchronisation."""
    if param.numel() == 0:
        return
    torch._fused_adam_(  # pyright: ignore[reportPrivateImportUsage]
        [param],
        [grad.to(param.dtype).contiguous()],
        [exp_avg],
        [exp_avg_sq],
        [],
        # torch.full is a kernel on the device: nothing is copied from the host.
        [step if isinstance(step, Tensor) else torch.full((), float(step), device=param.device)],
        lr=lr,
        beta1=betas[0],
        beta2=betas[1],
        weight_decay=0.0,
        eps=eps,
        amsgrad=False,
        maximize=False,
    )

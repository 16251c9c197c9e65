# SPDX-License-Identifier: Apache-2.0
"""Adam in this package's C++; the contract is ``kernels.operations.AdamStep``."""

import torch
from torch import Tensor

from structgstream.errors import BackendError
from structgstream.kernels._load import native_library
from structgstream.kernels.prototypes import addresses


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
    """See ``kernels.operations.AdamStep``.

    Raises:
        BackendError: a tensor is not contiguous float32, or the shapes differ.
    """
    for tensor in (param, exp_avg, exp_avg_sq):
        if tensor.dtype != torch.float32 or not tensor.is_contiguous() or tensor.shape != grad.shape:
            raise BackendError(
                f"The cpu back-end steps contiguous float32 tensors shaped like their gradient {tuple(grad.shape)}, "
                f"got {tensor.dtype} {tuple(tensor.shape)}; take the reference back-end for others."
            )
    grad = grad.to(torch.float32).contiguous()
    native_library().sgs_adam_step(
        *addresses(param, grad, exp_avg, exp_avg_sq, None),
        param.numel(),
        1,
        float(lr),
        int(step),
        *betas,
        eps,
        torch.get_num_threads(),
    )

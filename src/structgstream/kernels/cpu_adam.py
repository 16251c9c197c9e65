# SPDX-License-Identifier: Apache-2.0
"""Adam in this package's C++; the contract is ``kernels.reference_adam``'s."""

import ctypes

import torch
from torch import Tensor

from structgstream.errors import BackendError
from structgstream.kernels._load import native_library


def adam_step(
    param: Tensor,
    grad: Tensor,
    exp_avg: Tensor,
    exp_avg_sq: Tensor,
    *,
    lr: float,
    step: int,
    betas: tuple[float, float],
    eps: float,
    rows: Tensor | None = None,
) -> None:
    """Move ``param`` in place by one step, see ``kernels.reference_adam.adam_step``; ``rows`` must not repeat.

    Raises:
        BackendError: a tensor is not contiguous float32, or the shapes differ.
    """
    for tensor in (param, exp_avg, exp_avg_sq):
        if tensor.dtype != torch.float32 or not tensor.is_contiguous() or tensor.shape != grad.shape:
            raise BackendError(
                f"The cpu back-end steps contiguous float32 tensors shaped like their gradient {tuple(grad.shape)}, "
                f"got {tensor.dtype} {tuple(tensor.shape)}; take the reference back-end for others."
            )
    if param.numel() == 0:
        return
    grad = grad.to(torch.float32).contiguous()
    width = param[0].numel() if param.ndim else 1
    count = param.numel() // width
    if rows is not None:
        rows = rows.to(torch.int64).contiguous()
        count = rows.shape[0]
        if count and (int(rows.min()) < 0 or int(rows.max()) >= param.shape[0]):
            raise BackendError(f"Rows to step must lie in 0 ... {param.shape[0] - 1}.")
    native_library().sgs_adam_step(
        *(ctypes.c_void_p(tensor.data_ptr()) for tensor in (param, grad, exp_avg, exp_avg_sq)),
        ctypes.c_void_p(None if rows is None else rows.data_ptr()),
        ctypes.c_int64(count),
        ctypes.c_int64(width),
        ctypes.c_double(lr),
        ctypes.c_int64(step),
        ctypes.c_double(betas[0]),
        ctypes.c_double(betas[1]),
        ctypes.c_double(eps),
        ctypes.c_int(torch.get_num_threads()),
    )

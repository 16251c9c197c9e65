# SPDX-License-Identifier: Apache-2.0
"""How far Gaussians stray from their anchors in this package's C++; the contract is ``kernels.reference_excess``'s."""

import ctypes
from typing import Any

import torch
from torch import Tensor

from structgstream.errors import BackendError
from structgstream.kernels._load import native_library


def _arguments(offsets: Tensor, scales: Tensor, limit: float) -> list[Any]:
    return [
        ctypes.c_void_p(offsets.data_ptr()),
        ctypes.c_void_p(scales.data_ptr()),
        ctypes.c_int64(offsets.shape[0]),
        ctypes.c_int64(offsets.shape[1]),
        ctypes.c_float(limit),
    ]


class _Excess(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, offsets: Tensor, log_scales: Tensor, limit: float) -> Tensor:
        scales = log_scales.exp()
        ctx.save_for_backward(offsets, scales)
        ctx.limit = limit
        return offsets.new_tensor(native_library().sgs_excess(*_arguments(offsets, scales, limit)))

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, None]:
        offsets, scales = ctx.saved_tensors
        found = torch.empty_like(offsets), torch.empty_like(scales)
        native_library().sgs_excess_backward(
            *_arguments(offsets, scales, ctx.limit),
            ctypes.c_float(float(gradients[0])),
            *(ctypes.c_void_p(gradient.data_ptr()) for gradient in found),
        )
        return *found, None


def excess(offsets: Tensor, log_scales: Tensor, limit: float) -> Tensor:
    """Sum of what goes beyond, see ``kernels.reference_excess.excess``; float32.

    Raises:
        BackendError: another precision.
    """
    if offsets.dtype != torch.float32 or log_scales.dtype != torch.float32:
        raise BackendError(
            f"The cpu back-end measures float32 offsets, not {offsets.dtype}; the reference back-end takes other "
            "precisions."
        )
    return _Excess.apply(offsets.contiguous(), log_scales.contiguous(), limit)  # type: ignore[return-value]

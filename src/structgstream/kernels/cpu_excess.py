# SPDX-License-Identifier: Apache-2.0
"""The loss on Gaussians' distances to their anchors in this package's C++; the contract is
``kernels.operations.Excess``."""

from typing import Any

import torch
from torch import Tensor

from structgstream.errors import BackendError
from structgstream.kernels._load import native_library
from structgstream.kernels.prototypes import addresses


class _Excess(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, offsets: Tensor, log_scales: Tensor, limit: float) -> Tensor:
        scales = log_scales.exp()
        ctx.save_for_backward(offsets, scales)
        ctx.limit = limit
        return offsets.new_tensor(native_library().sgs_excess(*addresses(offsets, scales), *offsets.shape[:2], limit))

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, None]:
        offsets, scales = ctx.saved_tensors
        found = torch.empty_like(offsets), torch.empty_like(scales)
        native_library().sgs_excess_backward(
            *addresses(offsets, scales), *offsets.shape[:2], ctx.limit, float(gradients[0]), *addresses(*found)
        )
        return *found, None


def excess(offsets: Tensor, log_scales: Tensor, limit: float) -> Tensor:
    """See ``kernels.operations.Excess``.

    Raises:
        BackendError: another precision.
    """
    if offsets.dtype != torch.float32 or log_scales.dtype != torch.float32:
        raise BackendError(
            f"The cpu back-end measures float32 offsets, not {offsets.dtype}; the reference back-end takes other "
            "precisions."
        )
    return _Excess.apply(offsets.contiguous(), log_scales.contiguous(), limit)  # type: ignore[return-value]

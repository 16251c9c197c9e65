# SPDX-License-Identifier: Apache-2.0
"""The volumes of Gaussians in this package's C++; the contract is ``kernels.operations.Volume``."""

import ctypes
from typing import Any

import torch
from torch import Tensor

from structgstream.errors import BackendError
from structgstream.kernels._load import native_library
from structgstream.kernels.prototypes import addresses


class _Volume(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, scales: Tensor, opacities: Tensor) -> tuple[Tensor, Tensor]:
        drawn = ctypes.c_int64()
        total = native_library().sgs_volume(*addresses(scales, opacities), len(scales), ctypes.byref(drawn))
        ctx.save_for_backward(scales)
        count = torch.tensor(drawn.value)
        ctx.mark_non_differentiable(count)
        return scales.new_tensor(total), count

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        (scales,) = ctx.saved_tensors
        gradient = torch.empty_like(scales)
        native_library().sgs_volume_backward(*addresses(scales), len(scales), float(gradients[0]), *addresses(gradient))
        return gradient, None


def volume(scales: Tensor, opacities: Tensor) -> tuple[Tensor, Tensor]:
    """See ``kernels.operations.Volume``.

    Raises:
        BackendError: another precision.
    """
    if scales.dtype != torch.float32 or opacities.dtype != torch.float32:
        raise BackendError(
            f"The cpu back-end sums float32 volumes, not {scales.dtype}; the reference back-end takes other precisions."
        )
    return _Volume.apply(scales.contiguous(), opacities.detach().contiguous())  # type: ignore[return-value]

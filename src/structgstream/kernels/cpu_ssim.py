# SPDX-License-Identifier: Apache-2.0
"""L1 and SSIM with their gradients in this package's C++; the contract is ``kernels.reference_ssim``'s."""

import ctypes
from typing import Any

import torch
from torch import Tensor

from structgstream.errors import BackendError
from structgstream.kernels._load import native_library


def _pointer(tensor: Tensor | None) -> ctypes.c_void_p:
    return ctypes.c_void_p(None if tensor is None else tensor.data_ptr())


def _targets(target: Tensor) -> tuple[ctypes.c_void_p, ctypes.c_void_p]:
    """The float and the uint8 argument, one of which is null."""
    is_bytes = target.dtype == torch.uint8
    return _pointer(None if is_bytes else target), _pointer(target if is_bytes else None)


class _L1SSIM(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        height, width = image.shape[:2]
        gradient = torch.empty_like(image) if ctx.needs_input_grad[0] else None
        sums = torch.empty(2, height, dtype=torch.float64)  # rows, summed here in a fixed order
        native_library().sgs_l1_ssim(
            _pointer(image),
            *_targets(target),
            ctypes.c_int(height),
            ctypes.c_int(width),
            _pointer(gradient),
            _pointer(sums[0]),
            _pointer(sums[1]),
            ctypes.c_int(torch.get_num_threads()),
        )
        ctx.save_for_backward(image, target, gradient)
        l1, ssim = (sums.cumsum(1)[:, -1] / image.numel()).float()
        return l1, ssim

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        to_l1, to_ssim = gradients
        image, target, ssim_gradient = ctx.saved_tensors
        gradient = torch.empty_like(image)
        native_library().sgs_l1_ssim_backward(
            _pointer(image),
            *_targets(target),
            _pointer(ssim_gradient),
            ctypes.c_int64(image.numel()),
            ctypes.c_float(float(to_l1) / image.numel()),
            ctypes.c_float(float(to_ssim)),
            _pointer(gradient),
            ctypes.c_int(torch.get_num_threads()),
        )
        return gradient, None


def l1_ssim(image: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Mean absolute difference and mean SSIM of ``image`` ``[H, W, 3]`` float32 against ``target`` (or uint8).

    Gradients flow to ``image`` only. Results do not depend on the number of threads.

    Raises:
        BackendError: another precision, layout or size than the C++ computes with.
    """
    if image.dtype != torch.float32 or target.dtype not in (torch.float32, torch.uint8):
        raise BackendError(
            f"The cpu back-end compares float32 pictures with float32 or uint8 ones, not {image.dtype} with "
            f"{target.dtype}; convert them or take the reference back-end."
        )
    if image.shape != target.shape or image.ndim != 3 or image.shape[2] != 3 or image.numel() == 0:
        raise BackendError(
            f"Two pictures [H, W, 3] of one size are expected, got {tuple(image.shape)} and {tuple(target.shape)}."
        )
    return _L1SSIM.apply(image.contiguous(), target.contiguous())  # type: ignore[return-value]


def ssim(image: Tensor, target: Tensor) -> Tensor:
    """Mean SSIM alone, see :func:`l1_ssim`."""
    return l1_ssim(image, target)[1]

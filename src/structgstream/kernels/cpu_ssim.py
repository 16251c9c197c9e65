# SPDX-License-Identifier: Apache-2.0
"""L1 and SSIM with their gradients in this package's C++; the contract is ``kernels.reference_ssim``'s."""

import ctypes
from typing import Any

import torch
from torch import Tensor

from structgstream.errors import BackendError
from structgstream.kernels._load import native_library
from structgstream.kernels.raster_types import count_pixels, tiles_of


def _pointer(tensor: Tensor | None) -> ctypes.c_void_p:
    return ctypes.c_void_p(None if tensor is None else tensor.data_ptr())


def _targets(target: Tensor) -> tuple[ctypes.c_void_p, ctypes.c_void_p]:
    """The float and the uint8 argument, one of which is null."""
    is_bytes = target.dtype == torch.uint8
    return _pointer(None if is_bytes else target), _pointer(target if is_bytes else None)


class _L1SSIM(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        image: Tensor,
        target: Tensor,
        gains: Tensor | None,
        biases: Tensor | None,
        tiles: Tensor | None,
    ) -> tuple[Tensor, Tensor]:
        height, width = image.shape[:2]
        gradient = torch.empty_like(image) if ctx.needs_input_grad[0] else None
        sums = torch.empty(2, height, dtype=torch.float64)  # rows, summed here in a fixed order
        native_library().sgs_l1_ssim(
            *_pictures(image, target, gains, biases, tiles),
            _pointer(gradient),
            _pointer(sums[0]),
            _pointer(sums[1]),
            ctypes.c_int(torch.get_num_threads()),
        )
        ctx.save_for_backward(image, target, gains, biases, tiles, gradient)
        counted = image.numel() if tiles is None else 3 * count_pixels(tiles, width, height)
        l1, ssim = sums.cumsum(1)[:, -1].tolist()
        of_the_rest = image.numel() - counted
        return image.new_tensor(l1 / image.numel()), image.new_tensor((ssim + of_the_rest) / image.numel())

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        to_l1, to_ssim = gradients
        image, target, gains, biases, tiles, ssim_gradient = ctx.saved_tensors
        gradient = torch.empty_like(image) if tiles is None else torch.zeros_like(image)
        native_library().sgs_l1_ssim_backward(
            *_pictures(image, target, gains, biases, tiles),
            _pointer(ssim_gradient),
            ctypes.c_float(float(to_l1) / image.numel()),
            ctypes.c_float(float(to_ssim)),
            _pointer(gradient),
            ctypes.c_int(torch.get_num_threads()),
        )
        return gradient, None, None, None, None


def _pictures(
    image: Tensor, target: Tensor, gains: Tensor | None, biases: Tensor | None, tiles: Tensor | None
) -> tuple[Any, ...]:
    return (
        _pointer(image),
        *_targets(target),
        *(ctypes.c_int(size) for size in image.shape[:2]),
        *(_pointer(tensor) for tensor in (gains, biases, tiles)),
    )


def l1_ssim(
    image: Tensor,
    target: Tensor,
    *,
    gains: Tensor | None = None,
    biases: Tensor | None = None,
    tiles: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Mean absolute difference and mean SSIM, see ``kernels.reference_ssim.l1_ssim``; float32.

    Results do not depend on the number of threads.

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
    constants = [None if t is None else t.detach().float().contiguous() for t in (gains, biases)]
    assert (gains is None) == (biases is None)
    assert all(t is None or t.shape == (3,) for t in constants)
    if tiles is not None:
        assert tiles.shape == tiles_of(image.shape[1], image.shape[0]), tiles.shape
        tiles = tiles.to(torch.uint8).contiguous()
    return _L1SSIM.apply(image.contiguous(), target.contiguous(), *constants, tiles)  # type: ignore[return-value]


def ssim(image: Tensor, target: Tensor) -> Tensor:
    """Mean SSIM alone, see :func:`l1_ssim`."""
    return l1_ssim(image, target)[1]

# SPDX-License-Identifier: Apache-2.0
"""L1 and SSIM with their gradients in this package's C++; the contract is ``kernels.operations.L1SSIM``."""

from typing import Any

import torch
from torch import Tensor

from structgstream.kernels._load import native_library
from structgstream.kernels.prototypes import addresses
from structgstream.kernels.raster_types import TileSelection
from structgstream.kernels.ssim_arguments import Comparison


class _L1SSIM(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, comparison: Comparison) -> tuple[Tensor, Tensor]:
        gradient = torch.empty_like(image) if ctx.needs_input_grad[0] else None
        sums = torch.empty(2, image.shape[0], dtype=torch.float64)  # of rows; added here in a fixed order
        native_library().sgs_l1_ssim(
            *comparison.arguments(image), *addresses(gradient, sums[0], sums[1]), torch.get_num_threads()
        )
        ctx.comparison = comparison
        ctx.save_for_backward(image, gradient)
        counted = image.numel() if comparison.tiles is None else 3 * comparison.tiles.count_pixels()
        l1, ssim = sums.cumsum(1)[:, -1].tolist()
        of_the_rest = image.numel() - counted
        return image.new_tensor(l1 / image.numel()), image.new_tensor((ssim + of_the_rest) / image.numel())

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        to_l1, to_ssim = gradients
        image, ssim_gradient = ctx.saved_tensors
        gradient = torch.empty_like(image) if ctx.comparison.tiles is None else torch.zeros_like(image)
        native_library().sgs_l1_ssim_backward(
            *ctx.comparison.arguments(image),
            *addresses(ssim_gradient),
            float(to_l1) / image.numel(),
            float(to_ssim),
            *addresses(gradient),
            torch.get_num_threads(),
        )
        return gradient, None


def l1_ssim(
    image: Tensor,
    target: Tensor,
    *,
    gains: Tensor | None = None,
    biases: Tensor | None = None,
    tiles: TileSelection | None = None,
) -> tuple[Tensor, Tensor]:
    """See ``kernels.operations.L1SSIM``; float32. Results do not depend on the number of threads.

    Raises:
        BackendError: a precision, layout or size that the C++ does not support.
    """
    return _L1SSIM.apply(image.contiguous(), Comparison.of(image, target, gains, biases, tiles))  # type: ignore[return-value]


def ssim(image: Tensor, target: Tensor) -> Tensor:
    """Mean SSIM alone, see :func:`l1_ssim`."""
    return l1_ssim(image, target)[1]

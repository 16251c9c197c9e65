# SPDX-License-Identifier: Apache-2.0
"""L1 and SSIM with their gradients in this package's CUDA; the contract is ``kernels.operations.L1SSIM``.

There is no host synchronisation: means and gradients stay on the device.
"""

from typing import Any

import torch
from torch import Tensor

from structgstream.kernels.cuda_library import KernelLibrary
from structgstream.kernels.prototypes import addresses
from structgstream.kernels.raster_types import TileSelection, tile_grid
from structgstream.kernels.ssim_arguments import Comparison


class _L1SSIM(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, library: KernelLibrary, image: Tensor, comparison: Comparison) -> tuple[Tensor, Tensor]:
        rows, columns = tile_grid(image.shape[1], image.shape[0])
        adjoints = image.new_empty(3, *image.shape) if ctx.needs_input_grad[1] else None
        sums, means = image.new_empty(2, rows * columns), image.new_empty(2)
        library.call(
            "sgs_cuda_l1_ssim",
            *comparison.arguments(image),
            *addresses(adjoints, sums, means),
            device=image.device,
        )
        ctx.library, ctx.comparison = library, comparison
        ctx.save_for_backward(image, adjoints)
        return means[0], means[1]

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[None, Tensor, None]:
        to_l1, to_ssim = (gradient.contiguous() for gradient in gradients)
        image, adjoints = ctx.saved_tensors
        gradient = torch.empty_like(image)
        ctx.library.call(
            "sgs_cuda_l1_ssim_backward",
            *ctx.comparison.arguments(image),
            *addresses(adjoints, to_l1, to_ssim, gradient),
            device=image.device,
        )
        return None, gradient, None


def l1_ssim(
    library: KernelLibrary,
    image: Tensor,
    target: Tensor,
    *,
    gains: Tensor | None = None,
    biases: Tensor | None = None,
    tiles: TileSelection | None = None,
) -> tuple[Tensor, Tensor]:
    """See ``kernels.operations.L1SSIM``; float32. Results repeat bit for bit.

    Raises:
        BackendError: a precision, layout, size or device that the kernels do not support.
    """
    comparison = Comparison.of(image, target, gains, biases, tiles)
    mask = None if tiles is None else tiles.mask
    library.check_devices(image, target, gains, biases, mask)
    return _L1SSIM.apply(library, image.contiguous(), comparison)  # type: ignore[return-value]

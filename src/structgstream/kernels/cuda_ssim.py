# SPDX-License-Identifier: Apache-2.0
"""L1 and SSIM with their gradients in this package's CUDA; the contract is ``kernels.operations.L1SSIM``.

There is no host synchronisation: means and gradients stay on the device.
"""

import ctypes
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from structgstream.errors import BackendError
from structgstream.kernels.prototypes import CUDA_PROTOTYPES, addresses, declare
from structgstream.kernels.raster_types import TileSelection, tile_grid
from structgstream.kernels.ssim_arguments import Comparison


@dataclass(frozen=True)
class LossLibrary:
    """The compiled functions of ``csrc/cuda/ssim.h`` and the device type of their memory.

    Args:
        library: the loaded library.
        device_type: ``cuda``; ``cpu`` for the emulation that tests build.
        stream: gives a device's stream as an integer (0: the default stream).
    """

    library: ctypes.CDLL
    device_type: str
    stream: Callable[[torch.device], int]

    def __post_init__(self) -> None:
        declare(self.library, CUDA_PROTOTYPES)

    def call(self, name: str, *arguments: int | None, device: torch.device) -> None:
        """Launch one function.

        Raises:
            BackendError: CUDA reports an error.
        """
        error = getattr(self.library, name)(*arguments, self.stream(device))
        if error:
            said = self.library.sgs_cuda_error(error).decode()
            raise BackendError(f"The CUDA loss kernels failed ({said}); take the cpu back-end, or report this.")


def cuda_stream(device: torch.device) -> int:
    """torch's current stream on ``device``."""
    return torch.cuda.current_stream(device).cuda_stream


class _L1SSIM(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, library: LossLibrary, image: Tensor, comparison: Comparison) -> tuple[Tensor, Tensor]:
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
    library: LossLibrary,
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
    elsewhere = [
        tensor.device
        for tensor in (image, target, gains, biases, mask)
        if tensor is not None and tensor.device.type != library.device_type
    ]
    if elsewhere:
        raise BackendError(
            f"The loss kernels read tensors on {library.device_type}, not on {elsewhere[0]}; move the tensors there."
        )
    return _L1SSIM.apply(library, image.contiguous(), comparison)  # type: ignore[return-value]

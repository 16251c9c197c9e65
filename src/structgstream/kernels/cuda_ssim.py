# SPDX-License-Identifier: Apache-2.0
"""L1 and SSIM with their gradients in this package's CUDA; the contract is ``kernels.reference_ssim``'s.

Nothing here waits for the GPU: means and gradients stay where the pictures are.
"""

import ctypes
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from structgstream.errors import BackendError
from structgstream.kernels.raster_types import tiles_of


@dataclass(frozen=True)
class LossLibrary:
    """The interface of ``csrc/cuda/ssim.h`` and the device whose memory it reads.

    Args:
        library: what was compiled.
        device_type: ``cuda``; ``cpu`` for the emulation that tests build.
        stream: the queue that a tensor's work goes to, as an integer (0: the default one).
    """

    library: ctypes.CDLL
    device_type: str
    stream: Callable[[torch.device], int]

    def call(self, name: str, *arguments: Any, device: torch.device) -> None:
        """Queue one function's work.

        Raises:
            BackendError: CUDA refused it.
        """
        error = getattr(self.library, name)(*arguments, ctypes.c_void_p(self.stream(device)))
        if error:
            self.library.sgs_cuda_error.restype = ctypes.c_char_p
            said = self.library.sgs_cuda_error(ctypes.c_int(error)).decode()
            raise BackendError(f"CUDA refused the loss kernels ({said}); take the cpu back-end, or report this.")


def cuda_stream(device: torch.device) -> int:
    """torch's current stream on ``device``."""
    return torch.cuda.current_stream(device).cuda_stream


def _pointer(tensor: Tensor | None) -> ctypes.c_void_p:
    return ctypes.c_void_p(None if tensor is None else tensor.data_ptr())


def _pictures(
    image: Tensor, target: Tensor, gains: Tensor | None, biases: Tensor | None, tiles: Tensor | None
) -> tuple[Any, ...]:
    is_bytes = target.dtype == torch.uint8
    return (
        _pointer(image),
        _pointer(None if is_bytes else target),
        _pointer(target if is_bytes else None),
        *(ctypes.c_int(size) for size in image.shape[:2]),
        *(_pointer(tensor) for tensor in (gains, biases, tiles)),
    )


class _L1SSIM(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        library: LossLibrary,
        image: Tensor,
        target: Tensor,
        gains: Tensor | None,
        biases: Tensor | None,
        tiles: Tensor | None,
    ) -> tuple[Tensor, Tensor]:
        height, width = image.shape[:2]
        rows, columns = tiles_of(width, height)
        adjoints = image.new_empty(3, *image.shape) if ctx.needs_input_grad[1] else None
        sums, means = image.new_empty(2, rows * columns), image.new_empty(2)
        library.call(
            "sgs_cuda_l1_ssim",
            *_pictures(image, target, gains, biases, tiles),
            _pointer(adjoints),
            _pointer(sums),
            _pointer(means),
            device=image.device,
        )
        ctx.library = library
        ctx.save_for_backward(image, target, gains, biases, tiles, adjoints)
        return means[0], means[1]

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        to_l1, to_ssim = (gradient.contiguous() for gradient in gradients)
        image, target, gains, biases, tiles, adjoints = ctx.saved_tensors
        gradient = torch.empty_like(image)
        ctx.library.call(
            "sgs_cuda_l1_ssim_backward",
            *_pictures(image, target, gains, biases, tiles),
            _pointer(adjoints),
            _pointer(to_l1),
            _pointer(to_ssim),
            _pointer(gradient),
            device=image.device,
        )
        return None, gradient, None, None, None, None


def l1_ssim(
    library: LossLibrary,
    image: Tensor,
    target: Tensor,
    *,
    gains: Tensor | None = None,
    biases: Tensor | None = None,
    tiles: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Mean absolute difference and mean SSIM, see ``kernels.reference_ssim.l1_ssim``; float32.

    With ``tiles`` the gradient is, inside them, that of the whole picture, and zero in the others, as on the CPU.
    Results repeat bit for bit.

    Raises:
        BackendError: another precision, layout, size or device than the kernels compute with.
    """
    if image.dtype != torch.float32 or target.dtype not in (torch.float32, torch.uint8):
        raise BackendError(
            f"The cuda back-end compares float32 pictures with float32 or uint8 ones, not {image.dtype} with "
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
        tiles = (
            tiles.contiguous().view(torch.uint8) if tiles.dtype == torch.bool else tiles.to(torch.uint8).contiguous()
        )
    elsewhere = [
        tensor.device
        for tensor in (image, target, *constants, tiles)
        if tensor is not None and tensor.device.type != library.device_type
    ]
    if elsewhere:
        raise BackendError(f"The loss kernels read memory of the {library.device_type}, not of {elsewhere[0]}.")
    return _L1SSIM.apply(library, image.contiguous(), target.contiguous(), *constants, tiles)  # type: ignore[return-value]

# SPDX-License-Identifier: Apache-2.0
"""Losses and the optimiser's step in this package's C++; ``reference_losses`` defines them."""

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from structgstream.errors import BackendError
from structgstream.kernels.native import constant, native_library
from structgstream.kernels.values import TileSelection


@dataclass(frozen=True)
class Comparison:
    """The arguments of ``l1_ssim`` except ``image``, for CPU and CUDA: contiguous, gains and biases float32."""

    target: Tensor
    gains: Tensor | None
    biases: Tensor | None
    tiles: TileSelection | None

    @classmethod
    def of(
        cls, image: Tensor, target: Tensor, gains: Tensor | None, biases: Tensor | None, tiles: TileSelection | None
    ) -> "Comparison":
        """The checked arguments.

        Raises:
            BackendError: a precision, layout or size that the kernels do not support.
        """
        if image.dtype != torch.float32 or target.dtype not in (torch.float32, torch.uint8):
            raise BackendError(
                f"The cpu and cuda back-ends compare float32 pictures with float32 or uint8 ones, not {image.dtype} "
                f"with {target.dtype}; convert them or take the reference back-end."
            )
        if image.shape != target.shape or image.ndim != 3 or image.shape[2] != 3 or image.numel() == 0:
            raise BackendError(
                f"Two pictures [H, W, 3] of one size are expected, got {tuple(image.shape)} and {tuple(target.shape)}."
            )
        gains, biases = (constant(t) for t in (gains, biases))
        assert (gains is None) == (biases is None)
        assert all(t is None or t.shape == (3,) for t in (gains, biases))
        assert tiles is None or (tiles.height, tiles.width) == image.shape[:2], tiles
        if tiles is not None:
            tiles = replace(tiles, mask=tiles.mask.contiguous())
        return cls(target.contiguous(), gains, biases, tiles)

    def arguments(self, image: Tensor) -> list[Tensor | int | None]:
        """The first arguments of a loss kernel."""
        is_bytes = self.target.dtype == torch.uint8
        targets = (None, self.target) if is_bytes else (self.target, None)
        mask = None if self.tiles is None else self.tiles.mask  # One byte per tile.
        return [image, *targets, *image.shape[:2], self.gains, self.biases, mask]


class _L1SSIM(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, comparison: Comparison) -> tuple[Tensor, Tensor]:
        gradient = torch.empty_like(image) if ctx.needs_input_grad[0] else None
        sums = torch.empty(2, image.shape[0], dtype=torch.float64)  # sums of rows; added here in a fixed order
        native_library().sgs_l1_ssim(*comparison.arguments(image), gradient, sums[0], sums[1], torch.get_num_threads())
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
        scale_l1, scale_ssim = float(to_l1) / image.numel(), float(to_ssim)
        native_library().sgs_l1_ssim_backward(
            *ctx.comparison.arguments(image), ssim_gradient, scale_l1, scale_ssim, gradient, torch.get_num_threads()
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
    """See ``reference_losses.l1_ssim``; float32. Results do not depend on the number of threads.

    Raises:
        BackendError: a precision, layout or size that the C++ does not support.
    """
    return _L1SSIM.apply(image.contiguous(), Comparison.of(image, target, gains, biases, tiles))  # type: ignore[return-value]


def _check_float32(work: str, *tensors: Tensor) -> None:
    for tensor in tensors:
        if tensor.dtype != torch.float32:
            raise BackendError(
                f"The cpu back-end {work} in float32, not in {tensor.dtype}; the reference back-end takes other "
                "precisions."
            )


class _Volume(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, scales: Tensor, opacities: Tensor) -> tuple[Tensor, Tensor]:
        drawn = ctypes.c_int64()
        total = native_library().sgs_volume(scales, opacities, len(scales), ctypes.byref(drawn))
        ctx.save_for_backward(scales)
        count = torch.tensor(drawn.value)
        ctx.mark_non_differentiable(count)
        return scales.new_tensor(total), count

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        (scales,) = ctx.saved_tensors
        gradient = torch.empty_like(scales)
        native_library().sgs_volume_backward(scales, len(scales), float(gradients[0]), gradient)
        return gradient, None


def volume(scales: Tensor, opacities: Tensor) -> tuple[Tensor, Tensor]:
    """See ``reference_losses.volume``.

    Raises:
        BackendError: another precision.
    """
    _check_float32("sums volumes", scales, opacities)
    return _Volume.apply(scales.contiguous(), opacities.detach().contiguous())  # type: ignore[return-value]


class _Excess(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, offsets: Tensor, log_scales: Tensor, limit: float) -> Tensor:
        scales = log_scales.exp()
        ctx.save_for_backward(offsets, scales)
        ctx.limit = limit
        return offsets.new_tensor(native_library().sgs_excess(offsets, scales, *offsets.shape[:2], limit))

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, None]:
        offsets, scales = ctx.saved_tensors
        found = torch.empty_like(offsets), torch.empty_like(scales)
        native_library().sgs_excess_backward(
            offsets, scales, *offsets.shape[:2], ctx.limit, float(gradients[0]), *found
        )
        return *found, None


def excess(offsets: Tensor, log_scales: Tensor, limit: float) -> Tensor:
    """See ``reference_losses.excess``.

    Raises:
        BackendError: another precision.
    """
    _check_float32("measures offsets", offsets, log_scales)
    return _Excess.apply(offsets.contiguous(), log_scales.contiguous(), limit)  # type: ignore[return-value]


class _WithGradients(torch.autograd.Function):
    """A sum whose C++ function also computes its gradients."""

    @staticmethod
    def forward(ctx: Any, total: float, gradients: list[Tensor], *values: Tensor) -> Tensor:
        ctx.save_for_backward(*gradients)
        return torch.tensor(total, dtype=torch.float32)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        return None, None, *(gradient * gradients[0] for gradient in ctx.saved_tensors)


def neighbour_difference(values: Tensor, neighbours: Tensor, shares: Tensor, *, slack: float) -> Tensor:
    """See ``reference_losses.neighbour_difference``.

    Raises:
        BackendError: another precision.
    """
    _check_float32("compares rows with their neighbours", values, shares)
    values, neighbours, shares = values.contiguous(), neighbours.contiguous(), shares.contiguous()
    gradient = torch.zeros_like(values)
    total = native_library().sgs_neighbour_difference(values, neighbours, shares, *neighbours.shape, slack, gradient)
    return _WithGradients.apply(total, [gradient], values)  # type: ignore[return-value]


def change_bits(values: Sequence[Tensor], before: Sequence[Tensor], steps: Sequence[float]) -> Tensor:
    """See ``reference_losses.change_bits``.

    Raises:
        BackendError: another precision.
    """
    _check_float32("estimates bits", *values, *before)
    total, gradients, contiguous = 0.0, [], [value.contiguous() for value in values]
    for value, old, step in zip(contiguous, before, steps, strict=True):
        assert value.shape == old.shape, (value.shape, old.shape)
        gradients.append(torch.empty_like(value))
        total += native_library().sgs_change_bits(value, old.contiguous(), value.numel(), step, gradients[-1])
    return _WithGradients.apply(total, gradients, *contiguous)  # type: ignore[return-value]


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
) -> None:
    """See ``reference_losses.adam_step``.

    Raises:
        BackendError: a tensor is not contiguous float32, or the shapes differ.
    """
    for tensor in (param, exp_avg, exp_avg_sq):
        if tensor.dtype != torch.float32 or not tensor.is_contiguous() or tensor.shape != grad.shape:
            raise BackendError(
                f"The cpu back-end steps contiguous float32 tensors shaped like their gradient {tuple(grad.shape)}, "
                f"got {tensor.dtype} {tuple(tensor.shape)}; take the reference back-end for others."
            )
    grad = grad.to(torch.float32).contiguous()
    numbers = (param.numel(), lr, step, *betas, eps)
    native_library().sgs_adam_step(param, grad, exp_avg, exp_avg_sq, *numbers, torch.get_num_threads())

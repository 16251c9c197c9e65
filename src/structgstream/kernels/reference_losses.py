# SPDX-License-Identifier: Apache-2.0
"""Losses and the optimiser's step in pure torch: the oracles, which also run on a GPU without compiled kernels.

SSIM (Wang et al., 2004) as 3D Gaussian splatting trains with it: 11 x 11 Gaussian window with sigma 1.5, zero padding,
C1 = 0.01^2, C2 = 0.03^2, mean over pixels and channels.
"""

# torch's operations on lists of tensors have a leading underscore; its own optimisers are built on them.
# pyright: reportPrivateImportUsage=false

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from structgstream.kernels.values import TileSelection

WINDOW_PIXELS = 11
SIGMA_PIXELS = 1.5
C1 = 0.01**2
C2 = 0.03**2


def window(like: Tensor) -> Tensor:
    """The normalised 1D Gaussian window, ``[11]``."""
    positions = torch.arange(WINDOW_PIXELS, dtype=like.dtype, device=like.device) - WINDOW_PIXELS // 2
    weights = torch.exp(-(positions**2) / (2 * SIGMA_PIXELS**2))
    return weights / weights.sum()


def blurred(planes: Tensor) -> Tensor:
    """Separable Gaussian blur with zero padding, ``[P, H, W]``."""
    weights, half, count = window(planes), WINDOW_PIXELS // 2, planes.shape[0]
    rows = weights.reshape(1, 1, 1, -1).expand(count, 1, 1, -1)
    columns = weights.reshape(1, 1, -1, 1).expand(count, 1, -1, 1)
    across = torch.nn.functional.conv2d(planes[None], rows, padding=(0, half), groups=count)
    return torch.nn.functional.conv2d(across, columns, padding=(half, 0), groups=count)[0]


def in_unit_range(target: Tensor, like: Tensor) -> Tensor:
    """A uint8 picture as floats in [0, 1]; a float picture as it is."""
    return target.to(like) / 255.0 if target.dtype == torch.uint8 else target


def ssim_map(image: Tensor, target: Tensor) -> Tensor:
    """SSIM at every pixel and channel, ``[H, W, 3]`` of two ``[H, W, 3]`` pictures in [0, 1]."""
    x, y = image.permute(2, 0, 1), target.permute(2, 0, 1)
    mean_x, mean_y, xx, yy, xy = blurred(torch.cat([x, y, x * x, y * y, x * y])).chunk(5)
    numerator = (2 * mean_x * mean_y + C1) * (2 * (xy - mean_x * mean_y) + C2)
    denominator = (mean_x**2 + mean_y**2 + C1) * (xx - mean_x**2 + yy - mean_y**2 + C2)
    return (numerator / denominator).permute(1, 2, 0)


def l1_ssim(
    image: Tensor,
    target: Tensor,
    *,
    gains: Tensor | None = None,
    biases: Tensor | None = None,
    tiles: TileSelection | None = None,
) -> tuple[Tensor, Tensor]:
    """Mean absolute difference and mean SSIM of ``gains * image + biases`` against ``target``.

    Args:
        image: ``[H, W, 3]``; the only argument with a gradient.
        target: ``[H, W, 3]``, float in [0, 1] or uint8.
        gains: ``[3]``; one when None.
        biases: ``[3]``; given with ``gains``.
        tiles: if given, pixels of the other tiles count as equal (difference 0, SSIM 1); those up to ten pixels
            from the selected tiles are still read. The gradient is that of the whole picture in the selected
            tiles, and zero in the others.
    """
    if gains is not None:
        assert biases is not None
        image = image * gains.detach() + biases.detach()
    reference = in_unit_range(target, image)
    if tiles is None:
        return (image - reference).abs().mean(), ssim_map(image, reference).mean()
    inside = tiles.pixels()[..., None]
    image = torch.where(inside, image, image.detach())
    difference, similarity = (image - reference).abs(), ssim_map(image, reference)
    return (
        _valued(difference.mean(), difference.masked_fill(~inside, 0.0).mean()),
        _valued(similarity.mean(), similarity.masked_fill(~inside, 1.0).mean()),
    )


def _valued(graph: Tensor, value: Tensor) -> Tensor:
    """``value`` with the gradient of ``graph``."""
    return value.detach() + (graph - graph.detach())


def volume(scales: Tensor, opacities: Tensor) -> tuple[Tensor, Tensor]:
    """Sum of the products of the three scales ``[N, 3]``, and the number of opacities ``[N]`` above zero.

    Gradients flow to ``scales``.
    """
    x, y, z = scales.unbind(1)
    return (x * y * z).sum(), (opacities > 0).sum()


def excess(offsets: Tensor, log_scales: Tensor, limit: float) -> Tensor:
    """Sum ``[]`` of max(|offsets ``[M, K, 3]`` x exp(log_scales ``[M, 3]``)| - ``limit``, 0)."""
    return torch.relu((offsets * log_scales.exp()[:, None]).abs() - limit).sum()


def neighbour_difference(values: Tensor, neighbours: Tensor, shares: Tensor, *, slack: float) -> Tensor:
    """Difference of rows from their neighbours: the sum ``[]`` of shares times smoothed distances.

    The distance of two rows is ``sqrt(|difference|^2 + slack^2) - slack``. Gradients flow to ``values``.

    Args:
        values: ``[M, 3]``.
        neighbours: ``[M, N]`` int64, rows to compare each row with.
        shares: ``[M, N]`` weights of these pairs.
        slack: positive; distances far below it are squared, distances far above it are linear.
    """
    # index_select and its gradient take four fifths of the time of indexing by a matrix.
    others = values.index_select(0, neighbours.reshape(-1)).reshape(*neighbours.shape, 3)
    squares = (others - values[:, None]).square().sum(-1)
    return (shares * ((squares + slack**2).sqrt() - slack)).sum()


class _ChangeBits(torch.autograd.Function):
    """Takes half the time of autograd's own graph. Operations on lists of tensors need a single launch on a GPU."""

    @staticmethod
    def forward(ctx: Any, before: list[Tensor], steps: list[float], *values: Tensor) -> Tensor:
        differences = torch._foreach_sub(values, before)
        ratios = torch._foreach_abs(differences)
        torch._foreach_div_(ratios, steps)
        torch._foreach_add_(ratios, 1.0)
        ctx.save_for_backward(*differences, *ratios)
        ctx.steps = steps
        return torch.stack([bits.sum() for bits in torch._foreach_log2(ratios)]).sum()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        count = len(ctx.steps)
        differences, ratios = ctx.saved_tensors[:count], ctx.saved_tensors[count:]
        found = torch._foreach_sign(differences)
        torch._foreach_div_(found, ratios)
        for gradient, step in zip(found, ctx.steps, strict=True):
            gradient.mul_(grads[0] / (step * math.log(2.0)))
        return None, None, *found


def change_bits(values: Sequence[Tensor], before: Sequence[Tensor], steps: Sequence[float]) -> Tensor:
    """Sum ``[]`` of log2(1 + |values - before| / step) over all numbers of all tensors; gradients flow to ``values``.

    Args:
        values: any shapes.
        before: of the same shapes, without gradient.
        steps: one for each tensor.
    """
    return _ChangeBits.apply([*before], [*steps], *values)  # type: ignore[return-value]


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
    """Update ``param`` in place by one step of ``torch.optim.Adam`` (``backend``, Note [Ownership]).

    Args:
        param: any shape.
        grad: like ``param``.
        exp_avg: first moment, updated in place.
        exp_avg_sq: second moment, updated in place.
        lr: learning rate.
        step: number of this step, from 1.
        betas: decay of the moments.
        eps: added to the root of the corrected second moment.
    """
    exp_avg.mul_(betas[0]).add_(grad, alpha=1.0 - betas[0])
    exp_avg_sq.mul_(betas[1]).addcmul_(grad, grad, value=1.0 - betas[1])
    denominator = (exp_avg_sq / (1.0 - betas[1] ** step)).sqrt_().add_(eps)
    param.addcdiv_(exp_avg, denominator, value=-lr / (1.0 - betas[0] ** step))

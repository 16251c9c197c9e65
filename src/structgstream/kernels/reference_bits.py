# SPDX-License-Identifier: Apache-2.0
"""Bits of changes in torch: the oracle, and what a GPU runs."""

# torch's operations on lists of tensors have a leading underscore; its own optimisers are built on them.
# pyright: reportPrivateImportUsage=false

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable


class _ChangeBits(torch.autograd.Function):
    """Autograd's own graph of it takes twice the time. Operations are on lists of tensors, which on a GPU is one launch
    for all of them."""

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
    """See ``kernels.operations.ChangeBits``."""
    return _ChangeBits.apply([*before], [*steps], *values)  # type: ignore[return-value]

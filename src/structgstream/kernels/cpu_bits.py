# SPDX-License-Identifier: Apache-2.0
"""Bits of changes in this package's C++; the contract is ``kernels.operations.ChangeBits``."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from structgstream.errors import BackendError
from structgstream.kernels._load import native_library
from structgstream.kernels.prototypes import addresses


class _ChangeBits(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, before: list[Tensor], steps: list[float], *values: Tensor) -> Tensor:
        gradients, total = [], 0.0
        for value, old, step in zip(values, before, steps, strict=True):
            gradient = torch.empty_like(value)
            total += native_library().sgs_change_bits(*addresses(value, old), value.numel(), step, *addresses(gradient))
            gradients.append(gradient)
        ctx.save_for_backward(*gradients)
        return torch.tensor(total, dtype=torch.float32)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        return None, None, *(gradient * gradients[0] for gradient in ctx.saved_tensors)


def change_bits(values: Sequence[Tensor], before: Sequence[Tensor], steps: Sequence[float]) -> Tensor:
    """See ``kernels.operations.ChangeBits``.

    Raises:
        BackendError: another precision.
    """
    for value, old in zip(values, before, strict=True):
        assert value.shape == old.shape, (value.shape, old.shape)
        if value.dtype != torch.float32 or old.dtype != torch.float32:
            raise BackendError(
                f"The cpu back-end prices changes of float32 numbers, not of {value.dtype} since {old.dtype}; the "
                "reference back-end takes other precisions."
            )
    contiguous = [value.contiguous() for value in values]
    return _ChangeBits.apply([old.contiguous() for old in before], [*steps], *contiguous)  # type: ignore[return-value]

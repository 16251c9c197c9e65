# SPDX-License-Identifier: Apache-2.0
"""The rate term of the loss: a price on changing bins since the last frame (Note [Bins])."""

# torch's operations on lists of tensors have a leading underscore; its own optimisers are built on them.
# pyright: reportPrivateImportUsage=false

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from structgstream.scene.state import ParameterName
from structgstream.training.parameters import ANCHOR_ROWS, FREE_ROWS, Parameters

_BITS_PER_KB: Final = 8000


class _Bits(torch.autograd.Function):
    """Sums ``[F]`` of log2(1 + |value - before| / step) of F fields; autograd's own graph of it takes twice the time.

    Operations are on lists of tensors, which on a GPU is one launch for all fields.
    """

    @staticmethod
    def forward(ctx: Any, before: list[Tensor], steps: list[float], *values: Tensor) -> Tensor:
        differences = torch._foreach_sub(values, before)
        ratios = torch._foreach_abs(differences)
        torch._foreach_div_(ratios, steps)
        torch._foreach_add_(ratios, 1.0)
        ctx.save_for_backward(*differences, *ratios)
        ctx.steps = steps
        return torch.stack([bits.sum() for bits in torch._foreach_log2(ratios)])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        count = len(ctx.steps)
        differences, ratios = ctx.saved_tensors[:count], ctx.saved_tensors[count:]
        found = torch._foreach_sign(differences)
        torch._foreach_div_(found, ratios)
        for gradient, of_bits, step in zip(found, grads[0].unbind(), ctx.steps, strict=True):
            gradient.mul_(of_bits / (step * math.log(2.0)))
        return None, None, *found


@dataclass(frozen=True)
class BitPrice:
    """An estimate of the bits of changes, as a loss term.

    A bit has the same price in every frame, however much moves: that gives the best pictures for the bytes of all.

    Args:
        weight: what a kilobyte adds to the loss.
        before: the last frame's values by name.
        steps: the quantization steps by name.
    """

    weight: float
    before: Mapping[ParameterName, Tensor]
    steps: Mapping[ParameterName, float]

    @classmethod
    def of(
        cls, parameters: Parameters, steps: Mapping[ParameterName, float], *, weight: float, free: bool
    ) -> "BitPrice | None":
        """The price of changing ``parameters`` from their present values; None for none.

        With ``free``, bits of free Gaussians are priced like those of anchors, else not at all.
        """
        names = (*ANCHOR_ROWS, *FREE_ROWS) if free else ANCHOR_ROWS
        paid: dict[ParameterName, float] = {
            name: steps[name] for name in names if name in steps and name in parameters.values
        }
        if not paid or weight <= 0.0:
            return None
        return cls(weight, {name: parameters.values[name].detach().clone() for name in paid}, paid)

    def after_pruning(self, keep: Tensor) -> "BitPrice":
        """The price after free Gaussians outside the mask ``keep`` were pruned; ones born since are not priced."""
        before = {
            name: value[keep[: len(value)]] if name in FREE_ROWS else value for name, value in self.before.items()
        }
        return replace(self, before=before)

    def price(self, values: Mapping[ParameterName, Tensor]) -> Tensor:
        """Weighted sum of log2(1 + distance in bins), in kilobytes."""
        priced = [_first_rows(values[name], len(self.before[name])) for name in self.steps]
        bits = _Bits.apply([self.before[name] for name in self.steps], [*self.steps.values()], *priced)
        return self.weight / _BITS_PER_KB * bits.sum()  # type: ignore[union-attr]


def _first_rows(value: Tensor, count: int) -> Tensor:
    return value if len(value) == count else value[:count]

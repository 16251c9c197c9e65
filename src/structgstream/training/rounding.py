# SPDX-License-Identifier: Apache-2.0
"""What will be sent, already while it is fitted: values on a grid, and a price on leaving the last frame's bin.

Note [Bins]
~~~~~~~~~~~
A dynamic value is an integer bin times a step. What is fitted moves freely, what is drawn is rounded, and the gradient
passes the rounding as if it were not there (straight-through). Bins are absolute, so the difference of two frames'
bins is exact and nothing drifts.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

if TYPE_CHECKING:
    from structgstream.training.parameters import ParameterName


class _Rounded(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, value: Tensor, step: float) -> Tensor:
        return (value / step).round() * step

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None]:
        return grads[0], None


def rounded(value: Tensor, step: float) -> Tensor:
    """``value`` on the grid of ``step``; the gradient is that of ``value``."""
    return _Rounded.apply(value, step)


@dataclass(frozen=True)
class RoundingConfig:
    """Steps of what is sent, in units of the normalised scene; 0: as it is."""

    position_step: float = 0.0
    scale_step: float = 0.0
    """Of logarithms."""
    rate_weight: float = 0.0
    """Weight of an anchor's bits in the loss."""

    @property
    def steps(self) -> "dict[ParameterName, float]":
        """Steps by name of what is rounded."""
        steps: dict[ParameterName, float] = {"anchor_positions": self.position_step, "offset_scales": self.scale_step}
        return {name: step for name, step in steps.items() if step > 0.0}


@dataclass(frozen=True)
class Rate:
    """An estimate of bits, to be paid for in the loss.

    Args:
        weight: of the mean number of bits of an anchor in the loss.
        before: the last frame's values by name.
        steps: the steps by name.
    """

    weight: float
    before: "Mapping[ParameterName, Tensor]"
    steps: "Mapping[ParameterName, float]"

    def of(self, values: "Mapping[ParameterName, Tensor]") -> Tensor:
        """The weighted price of leaving the bins of the last frame: log2(1 + distance in bins), a mean over anchors."""
        bits = [
            torch.log2(1.0 + (values[name] - self.before[name]).abs() / step).sum() / max(len(self.before[name]), 1)
            for name, step in self.steps.items()
        ]
        return self.weight * torch.stack(bits).sum()

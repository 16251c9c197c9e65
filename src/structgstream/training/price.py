# SPDX-License-Identifier: Apache-2.0
"""The rate term of the loss: a price on changing bins since the last frame (Note [Bins])."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from structgstream.scene.state import ParameterName
from structgstream.training.parameters import ANCHOR_ROWS, FREE_ROWS, Parameters


@dataclass(frozen=True)
class BitPrice:
    """An estimate of the bits of changes, as a loss term.

    Args:
        weight: weight in the loss of the bits per anchor.
        before: the last frame's values by name.
        steps: the quantization steps by name.
        rows: number of moving anchors, by which the bits are divided.
    """

    weight: float
    before: Mapping[ParameterName, Tensor]
    steps: Mapping[ParameterName, float]
    rows: int

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
        rows = len(parameters.values["anchor_positions"])
        return cls(weight, {name: parameters.values[name].detach().clone() for name in paid}, paid, rows)

    def after_pruning(self, keep: Tensor) -> "BitPrice":
        """The price after free Gaussians outside the mask ``keep`` were pruned; ones born since are not priced."""
        before = {
            name: value[keep[: len(value)]] if name in FREE_ROWS else value for name, value in self.before.items()
        }
        return replace(self, before=before)

    def price(self, values: Mapping[ParameterName, Tensor]) -> Tensor:
        """Weighted sum of log2(1 + distance in bins), divided by the number of anchors."""
        bits = [
            torch.log2(1.0 + (values[name][: len(self.before[name])] - self.before[name]).abs() / step).sum()
            for name, step in self.steps.items()
        ]
        return self.weight / max(self.rows, 1) * torch.stack(bits).sum()

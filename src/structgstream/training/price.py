# SPDX-License-Identifier: Apache-2.0
"""A price in the loss on leaving the last frame's bin (Note [Bins])."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from structgstream.scene.state import ParameterName
from structgstream.training.parameters import ANCHOR_ROWS, FREE_ROWS, Parameters


@dataclass(frozen=True)
class BitPrice:
    """An estimate of bits, to be paid for in the loss.

    Args:
        weight: of the mean number of bits of an anchor in the loss.
        before: the last frame's values by name.
        steps: the steps by name.
        rows: anchors that may move: what bits are counted by.
    """

    weight: float
    before: Mapping[ParameterName, Tensor]
    steps: Mapping[ParameterName, float]
    rows: int

    @classmethod
    def of(
        cls, parameters: Parameters, steps: Mapping[ParameterName, float], *, weight: float, free: bool
    ) -> "BitPrice | None":
        """The price of leaving what ``parameters`` are now; None for nothing.

        With ``free`` a free Gaussian's bit costs what an anchor's does, else nothing.
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
        """The price after free Gaussians without the mask ``keep`` have died; what was or is born behind those that had
        one has none."""
        before = {
            name: value[keep[: len(value)]] if name in FREE_ROWS else value for name, value in self.before.items()
        }
        return replace(self, before=before)

    def price(self, values: Mapping[ParameterName, Tensor]) -> Tensor:
        """log2(1 + distance in bins), summed, divided by the number of anchors, weighted."""
        bits = [
            torch.log2(1.0 + (values[name][: len(self.before[name])] - self.before[name]).abs() / step).sum()
            for name, step in self.steps.items()
        ]
        return self.weight / max(self.rows, 1) * torch.stack(bits).sum()

# SPDX-License-Identifier: Apache-2.0
"""The rate term of the loss: a price on changing bins since the last frame (Note [Bins])."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

from torch import Tensor

from structgstream.kernels.backend import Backend
from structgstream.scene.state import ParameterName
from structgstream.training.parameters import ANCHOR_ROWS, FREE_ROWS, Parameters

_BITS_PER_KB: Final = 8000


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

    def price(self, values: Mapping[ParameterName, Tensor], backend: Backend) -> Tensor:
        """Weighted sum of log2(1 + distance in bins), in kilobytes."""
        priced = [_first_rows(values[name], len(self.before[name])) for name in self.steps]
        before = [self.before[name] for name in self.steps]
        return self.weight / _BITS_PER_KB * backend.change_bits(priced, before, [*self.steps.values()])


def _first_rows(value: Tensor, count: int) -> Tensor:
    return value if len(value) == count else value[:count]

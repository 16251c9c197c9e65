# SPDX-License-Identifier: Apache-2.0
"""How the value of a field is rounded, what its change is estimated to cost, and which integers are sent.

Note [Bins]
~~~~~~~~~~~
A dynamic value is sent as an integer bin times a step. Leaves are continuous, renderings use the quantized values, and
gradients pass the rounding unchanged (straight-through). Bins are absolute, so differences between frames are exact
integers and errors do not accumulate. The rate term is what changes of bins since the previous frame cost. A
dequantized value is the float32 product of bin and step, rounded by IEEE 754, so every decoder gets the same bits
(docs/bitstream.md, section Bins).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from structgstream.codec.entropy.bits import Bins
from structgstream.errors import StreamError
from structgstream.kernels.backend import Backend
from structgstream.scene.state import FieldName, ParameterName, trainable

# torch's operations on lists of tensors have a leading underscore; its own optimisers are built on them.
# pyright: reportPrivateImportUsage=false

LARGEST = 2**22
"""Largest magnitude of a bin: up to here, quantizing the rounded float32 product gives the same bin again."""


def float32(value: float) -> float:
    """The nearest float32 number; steps are stored as such."""
    return float(np.float32(value))


def quantize(value: Tensor, step: float | NDArray[np.float32]) -> Bins:
    """Quantizes a tensor: each value to the nearest bin. Raises StreamError if a bin is beyond :data:`LARGEST`."""
    found = np.rint(value.detach().cpu().numpy().astype(np.float64) / np.asarray(step, np.float32))
    if found.size and not np.abs(found).max() <= LARGEST:
        raise StreamError(f"A value is {np.abs(found).max():g} steps from zero, at most {LARGEST} can be coded.")
    return found.astype(np.int32)


def dequantize(bins: Bins, step: float | NDArray[np.float32]) -> Tensor:
    """Dequantizes bins: float32 products of bin and step."""
    return torch.from_numpy(bins.astype(np.float32) * np.asarray(step, np.float32))


def check_range(bins: NDArray[np.integer], where: str) -> None:
    """Check decoded bins of any shape. Raises StreamError if one is beyond :data:`LARGEST`."""
    if bins.size and not -LARGEST <= int(bins.min()) <= int(bins.max()) <= LARGEST:
        raise StreamError(f"{where} has a bin beyond 22 bits, the largest allowed; it is damaged.")


def round_to_bins(state: Mapping[FieldName, Tensor], steps: Mapping[FieldName, float]) -> dict[FieldName, Tensor]:
    """Quantizes and dequantizes the fields that have a step; others are returned as they are. Raises StreamError if a
    bin is beyond :data:`LARGEST`."""
    return {
        name: dequantize(quantize(value, steps[name]), steps[name]) if name in steps else value
        for name, value in state.items()
    }


class _RoundStraightThrough(torch.autograd.Function):
    """Operations are on lists of tensors, which on a GPU is one launch for all of them."""

    @staticmethod
    def forward(ctx: Any, steps: list[float], *values: Tensor) -> tuple[Tensor, ...]:
        found = torch._foreach_div(values, steps)
        torch._foreach_round_(found)
        torch._foreach_mul_(found, steps)
        return tuple(found)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        return None, *grads


def round_straight_through(value: Tensor, step: float) -> Tensor:
    """``value`` on the grid of ``step``; the gradient is that of ``value``."""
    return round_all_straight_through([value], [step])[0]


def round_all_straight_through(values: Sequence[Tensor], steps: Sequence[float]) -> tuple[Tensor, ...]:
    """Each of ``values`` on the grid of its step; the gradients are those of ``values``."""
    return _RoundStraightThrough.apply([*steps], *values) if values else ()  # type: ignore[return-value]


_BITS_PER_KB: Final = 8000


@dataclass(frozen=True)
class RateTerm:
    """An estimate of the bits of changes, as a loss term.

    A bit has the same weight in every frame, however much moves: that gives the best pictures for the bytes of all.
    """

    weight: float  # what a kilobyte adds to the loss
    before: Mapping[ParameterName, Tensor]  # the last frame's values by name
    steps: Mapping[ParameterName, float]  # the quantization steps by name

    @classmethod
    def of(
        cls,
        values: Mapping[ParameterName, Tensor],
        steps: Mapping[ParameterName, float],
        *,
        weight: float,
        free: bool,
    ) -> "RateTerm | None":
        """The rate term of changes from the present ``values`` of anchors' parameters and, if ``free``, of those of
        free Gaussians; only parameters in ``steps`` count. None if there is none, or if ``weight``, what a kilobyte
        adds to the loss, is not positive."""
        names = (*trainable("anchor"), *trainable("free")) if free else trainable("anchor")
        counted: dict[ParameterName, float] = {name: steps[name] for name in names if name in steps and name in values}
        if not counted or weight <= 0.0:
            return None
        return cls(weight, {name: values[name].detach().clone() for name in counted}, counted)

    @property
    def weight_per_bit(self) -> float:
        """What a bit adds to the loss."""
        return self.weight / _BITS_PER_KB

    def after_pruning(self, keep: Tensor) -> "RateTerm":
        """The term after free Gaussians outside the mask ``keep`` were pruned; ones spawned since have none."""
        rows = trainable("free")
        before = {name: value[keep[: len(value)]] if name in rows else value for name, value in self.before.items()}
        return replace(self, before=before)

    def value(self, values: Mapping[ParameterName, Tensor], backend: Backend) -> Tensor:
        """The loss term: the sum of log2(1 + distance in bins), in bits, times :attr:`weight_per_bit`."""
        changed = [_first_rows(values[name], len(self.before[name])) for name in self.steps]
        before = [self.before[name] for name in self.steps]
        return self.weight_per_bit * backend.change_bits(changed, before, [*self.steps.values()])


def _first_rows(value: Tensor, count: int) -> Tensor:
    return value if len(value) == count else value[:count]

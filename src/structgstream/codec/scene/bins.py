# SPDX-License-Identifier: Apache-2.0
"""A scene's dynamic fields as bins: whole numbers times a step (docs/bitstream.md, section Bins).

The value of a bin is the product of two float32 numbers, rounded as IEEE 754 rounds it: the same in every decoder.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from structgstream.codec.arrays import Bins
from structgstream.codec.scene.change import Change
from structgstream.errors import StreamError
from structgstream.scene.state import FIELDS, FREE_COLUMNS, FieldName, Granularity, fields_of

FREE_PARAMETERS = FIELDS["free"].parameters
LARGEST = 2**22
"""Of bins: with their products rounded to float32, the nearest bin of a value is still the one it was made of."""


@dataclass(frozen=True)
class FreeBins:
    """Free Gaussians as bins.

    Args:
        births: int64 ``[F]``, ascending.
        bins: ``[F, 14]``.
        change: what the last frame did to them; what was born in it did not change.
    """

    births: NDArray[np.int64]
    bins: Bins
    change: Change

    @classmethod
    def none(cls) -> "FreeBins":
        """No free Gaussians."""
        return cls(np.zeros(0, np.int64), np.zeros((0, FREE_COLUMNS), np.int32), Change.none(0, FREE_COLUMNS))

    def without_change(self) -> "FreeBins":
        """The same, without a last change: what a key frame starts from."""
        return FreeBins(self.births, self.bins, Change.none(len(self.births), FREE_COLUMNS))


@dataclass(frozen=True)
class SceneBins:
    """The dynamic part of a scene, and what the last frame did to it.

    Args:
        anchors: ``[M, columns of the dynamic anchor fields]``.
        columns: ``(name, first column, end)`` of each of these fields.
        change: of the anchors.
        weights: by field, ``[P, 1]``.
        weight_changes: by field.
        free: the free Gaussians.
    """

    anchors: Bins
    columns: Sequence[tuple[FieldName, int, int]]
    change: Change
    weights: Mapping[FieldName, Bins]
    weight_changes: Mapping[FieldName, Change]
    free: FreeBins

    def without_change(self) -> "SceneBins":
        """The same without a last change."""
        return replace(
            self,
            change=Change.none(*self.anchors.shape),
            weight_changes={name: Change.none(*bins.shape) for name, bins in self.weights.items()},
            free=self.free.without_change(),
        )


def quantized_fields(granularity: Granularity) -> tuple[FieldName, ...]:
    """The fields that can change as bins: the anchors' as rows, shared ones as weights, in the order of the table."""
    return tuple(name for name in fields_of(granularity) if FIELDS[name].quantized)


def quantize_state(
    state: Mapping[FieldName, Tensor], dynamic: frozenset[FieldName], steps: Mapping[str, float]
) -> SceneBins:
    """The nearest bins of a state's dynamic fields.

    Raises:
        StreamError: a value is too many steps from zero.
    """
    names: list[FieldName] = [name for name in quantized_fields("anchor") if name in dynamic]
    rows = [quantize(state[name], steps[name]) for name in names]
    count = len(state["anchor_positions"])
    anchors = np.concatenate(rows, axis=1) if rows else np.zeros((count, 0), np.int32)
    ends = accumulate(found.shape[1] for found in rows)
    columns: list[tuple[FieldName, int, int]] = [
        (name, end - found.shape[1], end) for name, found, end in zip(names, rows, ends, strict=True)
    ]
    weights: dict[FieldName, Bins] = {
        name: quantize(state[name], steps[name])[:, None] for name in quantized_fields("shared") if name in dynamic
    }
    free = FreeBins.none()
    if "free" in dynamic:
        births = state["free_births"].cpu().numpy().astype(np.int64)
        bins = quantize(state["free"], _free_steps(steps))
        free = FreeBins(births, bins, Change.none(len(births), FREE_COLUMNS))
    changes: dict[FieldName, Change] = {name: Change.none(*bins.shape) for name, bins in weights.items()}
    return SceneBins(anchors, columns, Change.none(*anchors.shape), weights, changes, free)


def dequantize_state(
    bins: SceneBins, dynamic: frozenset[FieldName], steps: Mapping[str, float]
) -> dict[FieldName, Tensor]:
    """The dynamic fields that bins stand for."""
    state: dict[FieldName, Tensor] = {}
    for name, first, end in bins.columns:
        state[name] = dequantize(bins.anchors[:, first:end], steps[name])
    for name, weights in bins.weights.items():
        state[name] = dequantize(weights[:, 0], steps[name])
    if "free" in dynamic:
        state["free"] = dequantize(bins.free.bins, _free_steps(steps))
        state["free_births"] = torch.from_numpy(bins.free.births.copy())
    return state


def round_to_bins(state: Mapping[FieldName, Tensor], steps: Mapping[FieldName, float]) -> dict[FieldName, Tensor]:
    """The fields that have a step, as their nearest bins stand for them; all others as they are.

    Raises:
        StreamError: a value is too many steps from zero.
    """
    return {
        name: dequantize(quantize(value, steps[name]), steps[name]) if name in steps else value
        for name, value in state.items()
    }


def _free_steps(steps: Mapping[str, float]) -> NDArray[np.float32]:
    widths = [parameter.columns for parameter in FREE_PARAMETERS]
    return np.repeat(np.array([steps[parameter.name] for parameter in FREE_PARAMETERS], np.float32), widths)


def quantize(value: Tensor, step: float | NDArray[np.float32]) -> Bins:
    """The bin nearest to every number of a tensor.

    Raises:
        StreamError: one is too many steps from zero.
    """
    found = np.rint(value.detach().cpu().numpy().astype(np.float64) / np.asarray(step, np.float32))
    if found.size and not np.abs(found).max() <= LARGEST:
        raise StreamError(f"A value is {np.abs(found).max():g} steps from zero, at most {LARGEST} can be coded.")
    return found.astype(np.int32)


def dequantize(bins: Bins, step: float | NDArray[np.float32]) -> Tensor:
    """What bins stand for."""
    return torch.from_numpy(bins.astype(np.float32) * np.asarray(step, np.float32))

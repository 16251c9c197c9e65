# SPDX-License-Identifier: Apache-2.0
"""Quantization of a scene's dynamic fields: integers (bins) times a step (docs/bitstream.md, section Bins).

A dequantized value is the float32 product of bin and step, rounded by IEEE 754, so every decoder gets the same bits.
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
"""Largest magnitude of a bin: up to here, quantizing the rounded float32 product gives the same bin again."""


@dataclass(frozen=True)
class FreeBins:
    """Free Gaussians as bins.

    Args:
        births: int64 ``[F]``, ascending.
        bins: ``[F, 14]``.
        change: by the last frame; zero for Gaussians born in it.
    """

    births: NDArray[np.int64]
    bins: Bins
    change: Change

    @classmethod
    def none(cls) -> "FreeBins":
        """No free Gaussians."""
        return cls(np.zeros(0, np.int64), np.zeros((0, FREE_COLUMNS), np.int32), Change.none(0, FREE_COLUMNS))

    def without_change(self) -> "FreeBins":
        """The same bins with zero change, as after a key packet."""
        return FreeBins(self.births, self.bins, Change.none(len(self.births), FREE_COLUMNS))


@dataclass(frozen=True)
class SceneBins:
    """The quantized dynamic fields of a scene, and their change by the last frame.

    Args:
        anchors: ``[M, columns of the dynamic anchor fields]``.
        columns: ``(name, first column, end)`` of each of these fields.
        change: of ``anchors``.
        weights: of MLPs and other shared fields, by field, ``[P, 1]``.
        weight_changes: of ``weights``, by field.
        free: the free Gaussians.
    """

    anchors: Bins
    columns: Sequence[tuple[FieldName, int, int]]
    change: Change
    weights: Mapping[FieldName, Bins]
    weight_changes: Mapping[FieldName, Change]
    free: FreeBins

    def without_change(self) -> "SceneBins":
        """The same bins with zero change."""
        return replace(
            self,
            change=Change.none(*self.anchors.shape),
            weight_changes={name: Change.none(*bins.shape) for name, bins in self.weights.items()},
            free=self.free.without_change(),
        )


def quantized_fields(granularity: Granularity) -> tuple[FieldName, ...]:
    """The fields of a granularity that packets can carry as bins, in the order of the table."""
    return tuple(name for name in fields_of(granularity) if FIELDS[name].quantized)


def quantize_state(
    state: Mapping[FieldName, Tensor], dynamic: frozenset[FieldName], steps: Mapping[str, float]
) -> SceneBins:
    """Quantizes the dynamic fields of a state.

    Raises:
        StreamError: a bin is beyond :data:`LARGEST`.
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
    """Dequantizes the dynamic fields."""
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
    """Quantizes and dequantizes the fields that have a step; others are returned as they are.

    Raises:
        StreamError: a bin is beyond :data:`LARGEST`.
    """
    return {
        name: dequantize(quantize(value, steps[name]), steps[name]) if name in steps else value
        for name, value in state.items()
    }


def _free_steps(steps: Mapping[str, float]) -> NDArray[np.float32]:
    widths = [parameter.columns for parameter in FREE_PARAMETERS]
    return np.repeat(np.array([steps[parameter.name] for parameter in FREE_PARAMETERS], np.float32), widths)


def quantize(value: Tensor, step: float | NDArray[np.float32]) -> Bins:
    """Quantizes a tensor: each value to the nearest bin.

    Raises:
        StreamError: a bin is beyond :data:`LARGEST`.
    """
    found = np.rint(value.detach().cpu().numpy().astype(np.float64) / np.asarray(step, np.float32))
    if found.size and not np.abs(found).max() <= LARGEST:
        raise StreamError(f"A value is {np.abs(found).max():g} steps from zero, at most {LARGEST} can be coded.")
    return found.astype(np.int32)


def dequantize(bins: Bins, step: float | NDArray[np.float32]) -> Tensor:
    """Dequantizes bins: float32 products of bin and step."""
    return torch.from_numpy(bins.astype(np.float32) * np.asarray(step, np.float32))

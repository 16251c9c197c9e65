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

from structgstream.codec.adaptive import AdaptiveCoder
from structgstream.codec.coder import Bins
from structgstream.codec.free_rows import FREE_PARAMETERS, FreeBins, coded_free
from structgstream.codec.rows import Change, coded_change
from structgstream.errors import StreamError
from structgstream.scene.state import FIELDS, FREE_COLUMNS, FieldName, Granularity, fields_of

LARGEST = 2**22
"""Of bins: with their products rounded to float32, the nearest bin of a value is still the one it was made of."""


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

    def unmoved(self) -> "SceneBins":
        """The same without a last change."""
        return replace(
            self,
            change=Change.none(*self.anchors.shape),
            weight_changes={name: Change.none(*bins.shape) for name, bins in self.weights.items()},
            free=self.free.unmoved(),
        )


def rounded_fields(granularity: Granularity) -> tuple[FieldName, ...]:
    """The fields that can change as bins: the anchors' as rows, shared ones as weights, in the order of the table."""
    return tuple(name for name in fields_of(granularity) if FIELDS[name].rounded)


def binned(state: Mapping[FieldName, Tensor], dynamic: frozenset[FieldName], steps: Mapping[str, float]) -> SceneBins:
    """The nearest bins of a state's dynamic fields.

    Raises:
        StreamError: a value is too many steps from zero.
    """
    names: list[FieldName] = [name for name in rounded_fields("anchor") if name in dynamic]
    rows = [nearest_bins(state[name], steps[name]) for name in names]
    count = len(state["anchor_positions"])
    anchors = np.concatenate(rows, axis=1) if rows else np.zeros((count, 0), np.int32)
    ends = accumulate(found.shape[1] for found in rows)
    columns: list[tuple[FieldName, int, int]] = [
        (name, end - found.shape[1], end) for name, found, end in zip(names, rows, ends, strict=True)
    ]
    weights: dict[FieldName, Bins] = {
        name: nearest_bins(state[name], steps[name])[:, None] for name in rounded_fields("shared") if name in dynamic
    }
    free = FreeBins.none()
    if "free" in dynamic:
        births = state["free_births"].cpu().numpy().astype(np.int64)
        bins = nearest_bins(state["free"], _free_steps(steps))
        free = FreeBins(births, bins, Change.none(len(births), FREE_COLUMNS))
    changes: dict[FieldName, Change] = {name: Change.none(*bins.shape) for name, bins in weights.items()}
    return SceneBins(anchors, columns, Change.none(*anchors.shape), weights, changes, free)


def valued(bins: SceneBins, dynamic: frozenset[FieldName], steps: Mapping[str, float]) -> dict[FieldName, Tensor]:
    """The dynamic fields that bins stand for."""
    state: dict[FieldName, Tensor] = {}
    for name, first, end in bins.columns:
        state[name] = values_of(bins.anchors[:, first:end], steps[name])
    for name, weights in bins.weights.items():
        state[name] = values_of(weights[:, 0], steps[name])
    if "free" in dynamic:
        state["free"] = values_of(bins.free.bins, _free_steps(steps))
        state["free_births"] = torch.from_numpy(bins.free.births.copy())
    return state


def coded_scene(
    coder: AdaptiveCoder, after: SceneBins | None, before: SceneBins, *, has_free: bool, where: str
) -> SceneBins:
    """Codes the bins of a frame after those of ``before``.

    Raises:
        StreamError: what is decoded contradicts itself.
    """
    given = None if after is None else Change.of(after.anchors - before.anchors)
    change = coded_change(coder, given, before.change, groups=before.columns)
    anchors = before.anchors + change.residuals
    weights: dict[FieldName, Bins] = {}
    changes: dict[FieldName, Change] = {}
    for name, bins in before.weights.items():
        given = None if after is None else Change.of(after.weights[name] - bins)
        changes[name] = coded_change(coder, given, before.weight_changes[name], groups=[(name, 0, 1)])
        weights[name] = bins + changes[name].residuals
    free = before.free
    if has_free:
        free = coded_free(coder, None if after is None else after.free, before.free, where=where)
    for found in (anchors, *weights.values(), free.bins):
        if found.size and not -LARGEST <= int(found.min()) <= int(found.max()) <= LARGEST:
            raise StreamError(f"{where} has a bin beyond 22 bits, which no value stands for; it is damaged.")
    return SceneBins(anchors, before.columns, change, weights, changes, free)


def _free_steps(steps: Mapping[str, float]) -> NDArray[np.float32]:
    widths = [parameter.columns for parameter in FREE_PARAMETERS]
    return np.repeat(np.array([steps[parameter.name] for parameter in FREE_PARAMETERS], np.float32), widths)


def nearest_bins(value: Tensor, step: float | NDArray[np.float32]) -> Bins:
    """The bin nearest to every number of a tensor.

    Raises:
        StreamError: one is too many steps from zero.
    """
    found = np.rint(value.detach().cpu().numpy().astype(np.float64) / np.asarray(step, np.float32))
    if found.size and not np.abs(found).max() <= LARGEST:
        raise StreamError(f"A value is {np.abs(found).max():g} steps from zero, at most {LARGEST} can be coded.")
    return found.astype(np.int32)


def values_of(bins: Bins, step: float | NDArray[np.float32]) -> Tensor:
    """What bins stand for."""
    return torch.from_numpy(bins.astype(np.float32) * np.asarray(step, np.float32))

# SPDX-License-Identifier: Apache-2.0
"""The dynamic fields of a scene as bins, and their coding given the frame before (docs/bitstream.md, Compact)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate

import numpy as np
import torch
from torch import Tensor

from structgstream.codec.entropy.adaptive import AdaptiveCoder
from structgstream.codec.entropy.bits import Bins
from structgstream.codec.fields.quantization import check_range, dequantize, quantize
from structgstream.codec.fields.rows import Change, FreeBins, code_change, code_free
from structgstream.scene.state import FIELDS, FieldName, Granularity, fields_of


def quantized_fields(granularity: Granularity) -> tuple[FieldName, ...]:
    """The fields of a granularity that packets can carry as bins, in the order of the table."""
    return tuple(name for name in fields_of(granularity) if FIELDS[name].quantized)


FREE_FIELDS: frozenset[FieldName] = frozenset(fields_of("free"))
"""Spawned, pruned and changed free Gaussians are coded together: these fields are all dynamic, or none is."""
CODABLE: frozenset[FieldName] = frozenset(quantized_fields("anchor") + quantized_fields("shared")) | FREE_FIELDS
"""Fields that may be dynamic."""


@dataclass(frozen=True)
class SceneBins:
    """The quantized dynamic fields of a scene, and their change by the last frame."""

    anchors: Bins  # [M, columns of the dynamic anchor fields]
    columns: Sequence[tuple[FieldName, int, int]]  # (name, first column, end) of each of these fields
    change: Change  # of anchors
    weights: Mapping[FieldName, Bins]  # of MLPs and other shared fields, by field, [P, 1]
    weight_changes: Mapping[FieldName, Change]  # of weights, by field
    free: FreeBins  # the free Gaussians

    def without_change(self) -> "SceneBins":
        """The same bins with zero change."""
        return replace(
            self,
            change=Change.none(*self.anchors.shape),
            weight_changes={name: Change.none(*bins.shape) for name, bins in self.weights.items()},
            free=self.free.without_change(),
        )


def quantize_state(
    state: Mapping[FieldName, Tensor], dynamic: frozenset[FieldName], steps: Mapping[str, float]
) -> SceneBins:
    """Quantizes the dynamic fields of a state. Raises StreamError if a bin is beyond 22 bits."""
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
        free = FreeBins.quantized(state["free"], state["free_births"], steps)
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
        state["free"] = bins.free.dequantized(steps)
        state["free_births"] = torch.from_numpy(bins.free.births.copy())
    return state


def code_scene(
    coder: AdaptiveCoder, after: SceneBins | None, before: SceneBins, *, has_free: bool, where: str
) -> SceneBins:
    """Codes the bins of a frame given those of the frame ``before``, in either direction. Raises StreamError if decoded
    values are out of range or inconsistent."""
    given = None if after is None else Change.of(after.anchors - before.anchors)
    change = code_change(coder, given, before.change, groups=before.columns)
    anchors = before.anchors + change.residuals
    weights: dict[FieldName, Bins] = {}
    changes: dict[FieldName, Change] = {}
    for name, bins in before.weights.items():
        given = None if after is None else Change.of(after.weights[name] - bins)
        changes[name] = code_change(coder, given, before.weight_changes[name], groups=[(name, 0, 1)])
        weights[name] = bins + changes[name].residuals
    free = before.free
    if has_free:
        free = code_free(coder, None if after is None else after.free, before.free, where=where)
    for found in (anchors, *weights.values(), free.bins):
        check_range(found, where)
    return SceneBins(anchors, before.columns, change, weights, changes, free)

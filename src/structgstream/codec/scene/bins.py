# SPDX-License-Identifier: Apache-2.0
"""A scene's dynamic fields as bins: whole numbers times a step (docs/bitstream.md, section Bins).

The value of a bin is the product of two float32 numbers, rounded as IEEE 754 rounds it: the same in every decoder.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from structgstream.codec.arrays import Bins
from structgstream.codec.scene.change import Change
from structgstream.errors import StreamError
from structgstream.scene.state import FREE_COLUMNS, FieldName

ANCHOR_ROWS: tuple[FieldName, ...] = ("anchor_positions", "offset_scales", "base_scales", "appearance")
"""Fields of an anchor, which change together."""
WEIGHTS: tuple[FieldName, ...] = ("opacity_mlp", "color_mlp", "covariance_mlp")
FREE_STEPS = ("free_means", "free_log_scales", "free_quats", "free_logit_opacities", "free_colors")
_FREE_WIDTHS = (3, 3, 4, 1, 3)
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

    def unmoved(self) -> "FreeBins":
        """The same, without a last change: what a key frame starts from."""
        return FreeBins(self.births, self.bins, Change.none(len(self.births), FREE_COLUMNS))


@dataclass(frozen=True)
class SceneBins:
    """The dynamic part of a scene, and what the last frame did to it.

    Args:
        anchors: ``[M, columns of the dynamic anchor fields]``.
        change: of the anchors.
        weights: by field, ``[P, 1]``.
        weight_changes: by field.
        free: the free Gaussians.
    """

    anchors: Bins
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


def anchor_fields(dynamic: frozenset[FieldName]) -> tuple[FieldName, ...]:
    """The dynamic fields of anchors, in the order of their columns."""
    return tuple(name for name in ANCHOR_ROWS if name in dynamic)


def anchor_columns(fields: Sequence[FieldName], total: int) -> list[tuple[FieldName, int, int]]:
    """``(name, first column, end)`` of each field: three columns, and for the appearance what remains of ``total``."""
    found: list[tuple[FieldName, int, int]] = []
    first = 0
    for name in fields:
        end = total if name == "appearance" else first + 3
        found.append((name, first, end))
        first = end
    return found


def binned(state: Mapping[FieldName, Tensor], dynamic: frozenset[FieldName], steps: Mapping[str, float]) -> SceneBins:
    """The nearest bins of a state's dynamic fields.

    Raises:
        StreamError: a value is too many steps from zero.
    """
    rows = [nearest_bins(state[name], steps[name]) for name in anchor_fields(dynamic)]
    count = len(state["anchor_positions"])
    anchors = np.concatenate(rows, axis=1) if rows else np.zeros((count, 0), np.int32)
    weights: dict[FieldName, Bins] = {
        name: nearest_bins(state[name], steps[name])[:, None] for name in WEIGHTS if name in dynamic
    }
    free = FreeBins.none()
    if "free" in dynamic:
        births = state["free_births"].cpu().numpy().astype(np.int64)
        bins = nearest_bins(state["free"], _free_steps(steps))
        free = FreeBins(births, bins, Change.none(len(births), FREE_COLUMNS))
    changes: dict[FieldName, Change] = {name: Change.none(*bins.shape) for name, bins in weights.items()}
    return SceneBins(anchors, Change.none(*anchors.shape), weights, changes, free)


def valued(bins: SceneBins, dynamic: frozenset[FieldName], steps: Mapping[str, float]) -> dict[FieldName, Tensor]:
    """The dynamic fields that bins stand for."""
    state: dict[FieldName, Tensor] = {}
    for name, first, end in anchor_columns(anchor_fields(dynamic), bins.anchors.shape[1]):
        state[name] = values_of(bins.anchors[:, first:end], steps[name])
    for name, weights in bins.weights.items():
        state[name] = values_of(weights[:, 0], steps[name])
    if "free" in dynamic:
        state["free"] = values_of(bins.free.bins, _free_steps(steps))
        state["free_births"] = torch.from_numpy(bins.free.births.copy())
    return state


def on_bins(state: Mapping[FieldName, Tensor], steps: Mapping[FieldName, float]) -> dict[FieldName, Tensor]:
    """The fields that have a step, as their nearest bins stand for them; all others as they are.

    Raises:
        StreamError: a value is too many steps from zero.
    """
    return {
        name: values_of(nearest_bins(value, steps[name]), steps[name]) if name in steps else value
        for name, value in state.items()
    }


def _free_steps(steps: Mapping[str, float]) -> NDArray[np.float32]:
    return np.repeat(np.array([steps[name] for name in FREE_STEPS], np.float32), _FREE_WIDTHS)


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

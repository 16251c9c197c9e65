# SPDX-License-Identifier: Apache-2.0
"""The dynamic fields of a scene as bins, and their coding given the frame before (docs/bitstream.md, Compact).

Neighbouring rows are correlated, as anchors are in Z-order. Passes go from every sixteenth row to every second, so that
each row except those of the first pass has coded neighbours on both sides as context.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from structgstream.codec.entropy.adaptive import AdaptiveCoder
from structgstream.codec.entropy.bits import Bins, Flags, bit_lengths
from structgstream.codec.fields.quantization import check_range, dequantize, quantize
from structgstream.errors import StreamError
from structgstream.scene.state import FIELDS, FREE_COLUMNS, FieldName, Granularity, fields_of

Name = TypeVar("Name", bound=str)
_MOST = 255  # a residual's magnitude is clamped to this in a size


@dataclass(frozen=True)
class Change:
    """The change of rows of bins by a frame, and which rows the two frames before changed."""

    residuals: Bins  # [n, C], zero in rows that did not change
    history: NDArray[np.uint8]  # u8 [n]: bit 0 is set if this frame changed the row, bits 1 and 2 if the two before did
    sizes: Bins  # i32 [n]: sum of the magnitudes of each row's residuals

    @property
    def active(self) -> Flags:
        """Mask ``[n]`` of the rows that changed."""
        return (self.history & 1).astype(np.bool_)

    @classmethod
    def none(cls, rows: int, columns: int) -> "Change":
        """A change of zero."""
        return cls(np.zeros((rows, columns), np.int32), np.zeros(rows, np.uint8), np.zeros(rows, np.int32))

    @classmethod
    def of(cls, residuals: Bins) -> "Change":
        """The change with these residuals ``[n, C]`` and no history."""
        return cls(residuals, (residuals != 0).any(axis=1).astype(np.uint8), row_sizes(residuals))

    def select(self, rows: NDArray[np.bool_]) -> "Change":
        """The change of the rows of a mask ``[n]``."""
        return Change(self.residuals[rows], self.history[rows], self.sizes[rows])

    def extended(self, rows: int) -> "Change":
        """The change with ``rows`` unchanged rows appended."""
        more = Change.none(rows, self.residuals.shape[1])
        return Change(
            np.concatenate([self.residuals, more.residuals]),
            np.concatenate([self.history, more.history]),
            np.concatenate([self.sizes, more.sizes]),
        )


def row_sizes(residuals: Bins) -> Bins:
    """Sum of the magnitudes of each row's residuals, clamped at 255, where contexts no longer distinguish them."""
    return np.minimum(np.abs(residuals), _MOST) @ np.ones(residuals.shape[1], np.int32)


_REMEMBERED = 7  # activity of three frames


def code_change(
    coder: AdaptiveCoder, change: Change | None, before: Change, *, groups: Sequence[tuple[str, int, int]]
) -> Change:
    """Codes a change (None when decoding), with the rows' previous change as context. Each group of columns ``(name,
    first, end)`` has a model; they cover all columns in order."""
    if not groups:
        return before
    active = coder.activity(
        f"{groups[0][0]}.active",
        None if change is None else change.active,
        history=before.history,
        sizes=before.sizes,
    )
    rows = np.flatnonzero(active)
    residuals = np.zeros_like(before.residuals)
    others = np.zeros(len(rows), np.int32)
    for name, first, end in groups:
        given = None if change is None else change.residuals[rows, first:end]
        found = coder.residuals(f"{name}.change", given, last=before.residuals[rows, first:end], others=others)
        residuals[rows, first:end] = found
        others = others + row_sizes(found)
    sizes = np.zeros(len(active), np.int32)
    sizes[rows] = others
    history = (before.history << 1 & _REMEMBERED | active).astype(np.uint8)
    return Change(residuals, history, sizes)


def _side_by_side(widths: Sequence[tuple[Name, int]]) -> list[tuple[Name, int, int]]:
    """Name, first column and end of groups of columns in this order."""
    ends = accumulate(width for _, width in widths)
    return [(name, end - width, end) for (name, width), end in zip(widths, ends)]


FREE_PARAMETERS = FIELDS["free"].parameters
GROUPS = _side_by_side([(parameter.path, parameter.columns) for parameter in FREE_PARAMETERS])
MAX_FREE = 2**18
"""Largest number of free Gaussians of a scene: symbols can cost less than a bit, so bytes do not bound it."""
_MEANS = range(6, 11)  # columns predicted from the mean: quaternions and opacities
_PREDICTED_BY_LEFT = (12, 13)  # columns predicted from the change in the column before: green and blue
_FRAME_BITS = 32  # an identity is frame * 2^32 + number


@dataclass(frozen=True)
class FreeBins:
    """Free Gaussians as bins."""

    births: NDArray[np.int64]  # int64 [F] identities, from the frame in which each was spawned; ascending
    bins: Bins  # [F, 14]
    change: Change  # by the last frame; zero for Gaussians spawned in it

    @classmethod
    def unchanged(cls, births: NDArray[np.int64], bins: Bins) -> "FreeBins":
        """Bins with zero change, as of spawned Gaussians, or after a key packet."""
        return cls(births, bins, Change.none(*bins.shape))

    @classmethod
    def none(cls) -> "FreeBins":
        """No free Gaussians."""
        return cls.unchanged(np.zeros(0, np.int64), np.zeros((0, FREE_COLUMNS), np.int32))

    def without_change(self) -> "FreeBins":
        """The same bins with zero change."""
        return FreeBins.unchanged(self.births, self.bins)


def _steps_of_columns(steps: Mapping[str, float]) -> NDArray[np.float32]:
    """The step of each column of free Gaussians, ``[14]``."""
    widths = [parameter.columns for parameter in FREE_PARAMETERS]
    return np.repeat(np.array([steps[parameter.name] for parameter in FREE_PARAMETERS], np.float32), widths)


def code_free(coder: AdaptiveCoder, after: FreeBins | None, before: FreeBins, *, where: str) -> FreeBins:
    """Codes pruned, changed and spawned Gaussians from ``before`` to ``after``, whose identities and bins are read.
    Raises StreamError if identities do not ascend or are out of range, or there are too many."""
    alive = None if after is None else np.isin(before.births, after.births)
    alive = coder.flags("free_births.alive", alive, [before.change.history], counts=[8])
    old = FreeBins(before.births[alive], before.bins[alive], before.change.select(alive))
    change: Change | None = None
    new: FreeBins | None = None
    if after is not None:
        kept = np.isin(after.births, before.births)
        change = Change.of(after.bins[kept] - old.bins)
        new = FreeBins.unchanged(after.births[~kept], after.bins[~kept])
    change = code_change(coder, change, old.change, groups=GROUPS)
    kept_bins = old.bins + change.residuals
    spawned = _code_spawned(coder, new, kept_bins, where=where)
    births = np.concatenate([old.births, spawned.births])
    if not (np.diff(births) > 0).all():
        raise StreamError(f"{where} has births that do not ascend; it is damaged.")
    bins = np.concatenate([kept_bins, spawned.bins])
    return FreeBins(births, bins, change.extended(len(spawned.births)))


def _code_spawned(coder: AdaptiveCoder, new: FreeBins | None, alive: Bins, *, where: str) -> FreeBins:
    """Codes the spawned Gaussians, given the bins of the survivors."""
    given = None if new is None else np.array([len(new.births)])
    count = int(coder.numbers("free_births.count", given, [np.zeros(1, np.int32)], counts=[1])[0])
    if not 0 <= count <= MAX_FREE - len(alive):
        raise StreamError(f"{where} adds {count} free Gaussians, which makes more than {MAX_FREE}, or fewer than none.")
    if not count:
        return FreeBins.none()
    nothing = np.zeros(count, np.int32)
    frames = numbers = None
    if new is not None:
        if int(new.births.min()) < 0:
            raise StreamError(f"{where} has births below 0.")
        frames, number = np.diff(new.births >> _FRAME_BITS, prepend=0), new.births & (1 << _FRAME_BITS) - 1
        numbers = np.where(frames != 0, number, np.diff(number, prepend=0))
    frames = coder.numbers("free_births.frame", frames, [nothing], counts=[1])
    fresh = frames != 0
    numbers = coder.numbers("free_births.number", numbers, [fresh], counts=[2])
    frame, number = np.cumsum(frames), _restarted_sums(numbers, fresh)
    for found, bits in ((frame, 31), (number, _FRAME_BITS)):
        if not 0 <= int(found.min()) <= int(found.max()) < 1 << bits:
            raise StreamError(f"{where} has births beyond 63 bits; it is damaged.")
    bins = _code_spawned_bins(coder, None if new is None else new.bins, alive, count=count, where=where)
    return FreeBins.unchanged((frame << _FRAME_BITS) + number, bins)


def _code_spawned_bins(coder: AdaptiveCoder, new: Bins | None, alive: Bins, *, count: int, where: str) -> Bins:
    """Codes the bins ``[count, 14]`` of spawned Gaussians, column by column.

    Most columns are predicted from the row before (the first from the last survivor). Quaternions and opacities, which
    vary little, are predicted from the survivors' mean; green and blue also by the change of the colour before.
    """
    start = alive[-1].astype(np.int64) if len(alive) else np.zeros(FREE_COLUMNS, np.int64)
    found = np.zeros((count, FREE_COLUMNS), np.int64)
    one, two = np.zeros((2, count), np.int64)  # prediction errors in the two columns before
    for column in range(FREE_COLUMNS):
        has_mean = column in _MEANS
        mean = int(alive[:, column].sum(dtype=np.int64)) // len(alive) if has_mean and len(alive) else 0
        left_change = np.diff(found[:, column - 1], prepend=start[column - 1]) if column in _PREDICTED_BY_LEFT else 0
        errors = None
        if new is not None:
            true = new[:, column].astype(np.int64)
            errors = true - mean if has_mean else np.diff(true, prepend=start[column]) - left_change
        length, before = _length(one), _length(two)
        errors = coder.numbers(
            "free.born",
            errors,
            [
                np.full(count, column),
                (column * 13 + length) * 3 + np.sign(one) + 1,
                column * 13 + np.minimum(length + before, 12),
            ],
            counts=[FREE_COLUMNS, FREE_COLUMNS * 39, FREE_COLUMNS * 13],
        )
        found[:, column] = errors + mean if has_mean else np.cumsum(errors + left_change) + start[column]
        if not -(2**31) <= int(found[:, column].min()) <= int(found[:, column].max()) < 2**31:
            raise StreamError(f"{where} has a bin beyond 32 bits; it is damaged.")
        one, two = errors, one
    return found.astype(np.int32)


def _length(errors: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.minimum(bit_lengths(np.abs(errors)), 12)


def _restarted_sums(steps: NDArray[np.int64], fresh: Flags) -> NDArray[np.int64]:
    """Running sums that restart at the first row and at every fresh row."""
    total = np.cumsum(steps)
    starts = np.flatnonzero(fresh | (np.arange(len(steps)) == 0))
    group = np.searchsorted(starts, np.arange(len(steps)), side="right") - 1
    base = total[starts] - steps[starts]
    return total - base[group]


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

    @classmethod
    def unchanged(
        cls,
        anchors: Bins,
        columns: Sequence[tuple[FieldName, int, int]],
        weights: Mapping[FieldName, Bins],
        free: FreeBins,
    ) -> "SceneBins":
        """Bins with zero change."""
        changes: dict[FieldName, Change] = {name: Change.none(*bins.shape) for name, bins in weights.items()}
        return cls(anchors, columns, Change.none(*anchors.shape), weights, changes, free.without_change())

    def without_change(self) -> "SceneBins":
        """The same bins with zero change."""
        return SceneBins.unchanged(self.anchors, self.columns, self.weights, self.free)


def quantize_state(
    state: Mapping[FieldName, Tensor], dynamic: frozenset[FieldName], steps: Mapping[str, float]
) -> SceneBins:
    """Quantizes the dynamic fields of a state. Raises StreamError if a bin is beyond 22 bits."""
    names: list[FieldName] = [name for name in quantized_fields("anchor") if name in dynamic]
    rows = [quantize(state[name], steps[name]) for name in names]
    nothing = np.zeros((len(state["anchor_positions"]), 0), np.int32)
    columns = _side_by_side([(name, found.shape[1]) for name, found in zip(names, rows)])
    weights: dict[FieldName, Bins] = {
        name: quantize(state[name], steps[name])[:, None] for name in quantized_fields("shared") if name in dynamic
    }
    free = FreeBins.none()
    if "free" in dynamic:
        births = state["free_births"].cpu().numpy().astype(np.int64)
        free = FreeBins.unchanged(births, quantize(state["free"], _steps_of_columns(steps)))
    return SceneBins.unchanged(np.concatenate([nothing, *rows], axis=1), columns, weights, free)


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
        state["free"] = dequantize(bins.free.bins, _steps_of_columns(steps))
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

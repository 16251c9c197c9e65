# SPDX-License-Identifier: Apache-2.0
"""Rows of bins that mostly stay: which ones change, and by how much (docs/bitstream.md, section Rows).

Rows stand in an order in which neighbours belong together. What is asked in a first pass of every second row gives the
rows between them two neighbours to lean on, so every pass knows all its contexts before it begins.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from structgstream.codec.coder import Bins, Coder, Contexts

_SIGNS = 2  # a residual's context tells -2 and less, -1, 0, 1, 2 and more
_CLASSES = 2 * _SIGNS + 1
ACTIVITY_CONTEXTS = 2 * 3 * 4
RESIDUAL_CONTEXTS = _CLASSES * (_CLASSES + 2)


@dataclass(frozen=True)
class Change:
    """What a frame did to rows of bins.

    Args:
        active: ``[n]``, the rows that changed.
        residuals: ``[n, C]``, zero where they did not.
    """

    active: NDArray[np.bool_]
    residuals: Bins

    @classmethod
    def none(cls, rows: int, columns: int) -> "Change":
        """Nothing changed."""
        return cls(np.zeros(rows, np.bool_), np.zeros((rows, columns), np.int32))

    @classmethod
    def of(cls, residuals: Bins) -> "Change":
        """What these residuals ``[n, C]`` make."""
        return cls((residuals != 0).any(axis=1), residuals)

    def select(self, rows: NDArray[np.bool_]) -> "Change":
        """Of the rows of a mask."""
        return Change(self.active[rows], self.residuals[rows])


def coded_change(
    coder: Coder, change: Change | None, before: Change, *, groups: Sequence[tuple[str, int, int]]
) -> Change:
    """Codes a change, which is like the one ``before``.

    Args:
        coder: either direction.
        change: what to code; None when decoding.
        before: the same rows' last change.
        groups: ``(name, first column, end)`` of columns that have tables of their own, all columns in their order.
    """
    if not groups:
        return before
    active = _coded_activity(coder, f"{groups[0][0]}.active", None if change is None else change.active, before.active)
    rows = np.flatnonzero(active)
    residuals = np.zeros_like(before.residuals)
    for name, first, end in groups:
        values = None if change is None else change.residuals[rows, first:end]
        last = before.residuals[rows, first:end]
        residuals[rows, first:end] = _coded_residuals(coder, f"{name}.change", values, last)
    return Change(active, residuals)


def _coded_activity(
    coder: Coder, name: str, active: NDArray[np.bool_] | None, before: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    count = len(before)
    around = np.zeros(count + 6, np.int64)
    around[3:-3] = before
    near = sum(around[3 + step : 3 + step + count] for step in (-3, -2, -1, 1, 2, 3))
    near = np.minimum((np.zeros(count, np.int64) + near + 1) // 2, 3)
    found = np.zeros(count, np.bool_)
    for first in (0, 1):
        rows = np.arange(first, count, 2)
        beside = np.zeros(len(rows), np.int64)
        if first:
            known = np.append(found, False)
            beside = known[rows - 1].astype(np.int64) + known[rows + 1]
        contexts = ((before[rows] * 3 + beside) * 4 + near[rows]).astype(np.uint16)
        values = None if active is None else active[rows]
        found[rows] = coder.flags(f"{name}{first}", values, contexts, count=ACTIVITY_CONTEXTS)
    return found


def _coded_residuals(coder: Coder, name: str, values: Bins | None, before: Bins) -> Bins:
    """Residuals ``[n, c]`` of active rows, every second row first."""
    count, columns = before.shape
    found = np.zeros((count + 1, columns), np.int32)
    own = np.clip(before, -_SIGNS, _SIGNS) + _SIGNS
    for first in (0, 1):
        rows = np.arange(first, count, 2)
        beside = np.full((len(rows), columns), _SIGNS + 1, np.int64)
        if first:
            both = found[rows - 1].astype(np.int64) + found[rows + 1]
            beside = np.clip(both, -_SIGNS - 1, _SIGNS + 1) + _SIGNS + 1
        contexts: Contexts = (own[rows] * (_CLASSES + 2) + beside).astype(np.uint16).ravel()
        given = None if values is None else values[rows].ravel()
        coded = coder.residuals(f"{name}{first}", given, contexts, count=RESIDUAL_CONTEXTS)
        found[rows] = coded.reshape(len(rows), columns)
    return found[:count]

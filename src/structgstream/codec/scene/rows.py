# SPDX-License-Identifier: Apache-2.0
"""Rows of bins that mostly stay: which ones change, and by how much (docs/bitstream.md, section Rows).

Rows stand in an order in which neighbours belong together. Passes go from every sixteenth row to every second, so that
each row but the first ones has a neighbour on either side that is known.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from structgstream.codec.entropy.adaptive import AdaptiveCoder
from structgstream.codec.entropy.coder import Bins, Flags

_REMEMBERED = 7  # activity of three frames
_MOST = 255  # of a size that counts


@dataclass(frozen=True)
class Change:
    """What a frame did to rows of bins, and whether those before it did anything.

    Args:
        residuals: ``[n, C]``, zero in rows that did not change.
        history: u8 ``[n]``: bit 0 says whether this frame changed the row, bits 1 and 2 whether those before did.
        sizes: i32 ``[n]``: of each row's residuals together.
    """

    residuals: Bins
    history: NDArray[np.uint8]
    sizes: Bins

    @property
    def active(self) -> Flags:
        """``[n]``, the rows that changed."""
        return (self.history & 1).astype(np.bool_)

    @classmethod
    def none(cls, rows: int, columns: int) -> "Change":
        """Nothing changed."""
        return cls(np.zeros((rows, columns), np.int32), np.zeros(rows, np.uint8), np.zeros(rows, np.int32))

    @classmethod
    def of(cls, residuals: Bins) -> "Change":
        """What these residuals ``[n, C]`` make."""
        return cls(residuals, (residuals != 0).any(axis=1).astype(np.uint8), _sizes(residuals))

    def select(self, rows: NDArray[np.bool_]) -> "Change":
        """Of the rows of a mask."""
        return Change(self.residuals[rows], self.history[rows], self.sizes[rows])

    def grown(self, rows: int) -> "Change":
        """With so many rows more, which did not change."""
        more = Change.none(rows, self.residuals.shape[1])
        return Change(
            np.concatenate([self.residuals, more.residuals]),
            np.concatenate([self.history, more.history]),
            np.concatenate([self.sizes, more.sizes]),
        )


def coded_change(
    coder: AdaptiveCoder, change: Change | None, before: Change, *, groups: Sequence[tuple[str, int, int]]
) -> Change:
    """Codes a change, which is like the one ``before``.

    Args:
        coder: either direction.
        change: what to code; None when decoding.
        before: the same rows' last change.
        groups: ``(name, first column, end)`` of columns that have models of their own, all columns in their order.
    """
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
        others = others + _sizes(found)
    sizes = np.zeros(len(active), np.int32)
    sizes[rows] = others
    history = (before.history << 1 & _REMEMBERED | active).astype(np.uint8)
    return Change(residuals, history, sizes)


def _sizes(residuals: Bins) -> Bins:
    """Of each row's residuals together; no context tells so large ones apart that the limit matters."""
    return np.minimum(np.abs(residuals), _MOST) @ np.ones(residuals.shape[1], np.int32)

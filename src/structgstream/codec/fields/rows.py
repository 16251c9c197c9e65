# SPDX-License-Identifier: Apache-2.0
"""Changes of rows of bins: which rows are active, and their residuals (docs/bitstream.md, section Rows).

Neighbouring rows are correlated, as anchors are in Z-order. Passes go from every sixteenth row to every second, so that
each row except those of the first pass has coded neighbours on both sides as context.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from structgstream.codec.entropy.adaptive import AdaptiveCoder
from structgstream.codec.entropy.bits import Bins, Flags

_MOST = 255  # a residual's magnitude is clamped to this in a size


@dataclass(frozen=True)
class Change:
    """The change of rows of bins by a frame, and which rows the two frames before changed.

    Args:
        residuals: ``[n, C]``, zero in rows that did not change.
        history: u8 ``[n]``: bit 0 is set if this frame changed the row, bits 1 and 2 if the two before did.
        sizes: i32 ``[n]``: sum of the magnitudes of each row's residuals.
    """

    residuals: Bins
    history: NDArray[np.uint8]
    sizes: Bins

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
    """Codes a change, with the rows' previous change as context.

    Args:
        coder: an encoder or a decoder.
        change: the change to encode; None when decoding.
        before: the same rows' previous change.
        groups: ``(name, first column, end)`` of the groups of columns with a model each; they cover all columns in
            order.
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
        others = others + row_sizes(found)
    sizes = np.zeros(len(active), np.int32)
    sizes[rows] = others
    history = (before.history << 1 & _REMEMBERED | active).astype(np.uint8)
    return Change(residuals, history, sizes)

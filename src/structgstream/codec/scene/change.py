# SPDX-License-Identifier: Apache-2.0
"""What a frame did to rows of bins."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from structgstream.codec.arrays import Bins, Flags

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
        return cls(residuals, (residuals != 0).any(axis=1).astype(np.uint8), row_sizes(residuals))

    def select(self, rows: NDArray[np.bool_]) -> "Change":
        """Of the rows of a mask."""
        return Change(self.residuals[rows], self.history[rows], self.sizes[rows])

    def extended(self, rows: int) -> "Change":
        """With so many rows more, which did not change."""
        more = Change.none(rows, self.residuals.shape[1])
        return Change(
            np.concatenate([self.residuals, more.residuals]),
            np.concatenate([self.history, more.history]),
            np.concatenate([self.sizes, more.sizes]),
        )


def row_sizes(residuals: Bins) -> Bins:
    """Of each row's residuals together; no context tells so large ones apart that the limit matters."""
    return np.minimum(np.abs(residuals), _MOST) @ np.ones(residuals.shape[1], np.int32)

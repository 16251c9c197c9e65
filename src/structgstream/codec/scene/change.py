# SPDX-License-Identifier: Apache-2.0
"""The change of rows of bins by a frame."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from structgstream.codec.arrays import Bins, Flags

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

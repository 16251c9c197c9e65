# SPDX-License-Identifier: Apache-2.0
"""Anchor points, the structured part of a scene (paper, section Structured 3DGs)."""

from dataclasses import dataclass

import torch
from torch import Tensor

from structgstream.gaussians import row_indices


@dataclass(frozen=True)
class AnchorCloud:
    """``M`` anchors with ``K`` structured Gaussians each.

    Args:
        positions: ``[M, 3]`` the paper's x_v, scene units.
        log_offset_scales: ``[M, 3]`` log of the paper's l_v, which multiplies the offsets. See Note [Two scales].
        log_base_scales: ``[M, 3]`` log of the upper bound of the Gaussians' scales.
        offsets: ``[M, K, 3]`` the paper's O_v, in units of l_v.
        features: ``[M, D]`` the paper's f_v.
        appearance: ``[M, R]`` change of the features since frame 0, as coefficients of the rows of the scene's
            ``appearance_basis``; None unless the configuration makes appearance dynamic.

    Note [Two scales]
    ~~~~~~~~~~~~~~~~~
    The paper's l_v has three components per anchor. Scaffold-GS, on which it builds, has six: three multiply the
    offsets, three bound the Gaussians' scales. We take l_v as the first three, because its only equation multiplies
    offsets by it. The others are ``log_base_scales``, static unless a configuration adds them to the dynamic set.
    """

    positions: Tensor
    log_offset_scales: Tensor
    log_base_scales: Tensor
    offsets: Tensor
    features: Tensor
    appearance: Tensor | None = None

    def __len__(self) -> int:
        return self.positions.shape[0]

    @property
    def offsets_per_anchor(self) -> int:
        """The paper's k, offsets (and so Gaussians) per anchor."""
        return self.offsets.shape[1]

    def select(self, rows: Tensor) -> "AnchorCloud":
        """The anchors of a mask ``[M]`` or of indices ``[m]``, contiguous."""
        rows = row_indices(rows, self.positions)
        return AnchorCloud(**{name: column[rows].contiguous() for name, column in self._columns().items()})

    def with_rows(self, rows: Tensor, other: "AnchorCloud") -> "AnchorCloud":
        """A copy in which the anchors of the mask ``rows`` ``[M]`` are replaced by ``other``."""
        rows = row_indices(rows, self.positions)
        columns = {name: column.clone() for name, column in self._columns().items()}
        for name, column in columns.items():
            column[rows] = getattr(other, name)
        return AnchorCloud(**columns)

    def append(self, other: "AnchorCloud") -> "AnchorCloud":
        """These anchors and then those of ``other``, which has the same columns."""
        return AnchorCloud(**{name: torch.cat([rows, getattr(other, name)]) for name, rows in self._columns().items()})

    def _columns(self) -> dict[str, Tensor]:
        return {name: column for name, column in vars(self).items() if column is not None}

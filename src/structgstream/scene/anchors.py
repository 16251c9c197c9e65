# SPDX-License-Identifier: Apache-2.0
"""Dynamic anchor points: the structured half of a scene (paper, section Structured 3DGs)."""

from dataclasses import dataclass, fields

from torch import Tensor


@dataclass(frozen=True)
class AnchorCloud:
    """``M`` anchors, each of which carries ``K`` structured Gaussians.

    Args:
        positions: ``[M, 3]`` the paper's x_v, scene units.
        log_offset_scales: ``[M, 3]`` log of the paper's l_v, which multiplies the offsets. See Note [Two scales].
        log_base_scales: ``[M, 3]`` log of the largest scale that the covariance head may give.
        offsets: ``[M, K, 3]`` the paper's O_v, in units of l_v.
        features: ``[M, D]`` the paper's f_v.
        appearance: ``[M, R]`` how far the features have left f_v since frame 0, along the rows of the scene's
            ``appearance_basis``; None unless a configuration lets appearance change.

    Note [Two scales]
    ~~~~~~~~~~~~~~~~~
    The paper's l_v has three numbers; Scaffold-GS, on which it builds, keeps six an anchor: three multiply offsets,
    three bound the Gaussians' scales. l_v is read as the first three (its only equation multiplies offsets by it); the
    others are ``log_base_scales``, static unless a configuration puts them in the dynamic set.
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
        """The paper's k."""
        return self.offsets.shape[1]

    def select(self, rows: Tensor) -> "AnchorCloud":
        """The anchors of a mask or of indices ``[m]``, contiguous."""
        return AnchorCloud(**{name: column[rows].contiguous() for name, column in self._columns().items()})

    def with_rows(self, rows: Tensor, other: "AnchorCloud") -> "AnchorCloud":
        """The same, those of the mask ``rows`` ``[M]`` replaced by ``other``; nothing is written in place."""
        columns = {name: column.clone() for name, column in self._columns().items()}
        for name, column in columns.items():
            column[rows] = getattr(other, name)
        return AnchorCloud(**columns)

    def _columns(self) -> dict[str, Tensor]:
        return {f.name: column for f in fields(self) if (column := getattr(self, f.name)) is not None}

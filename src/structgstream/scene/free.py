# SPDX-License-Identifier: Apache-2.0
"""Free Gaussians, which represent what the anchors cannot (paper, Global Free 3DGs Patching Strategy)."""

from dataclasses import dataclass

import torch
from torch import Tensor

from structgstream.gaussians import row_indices


@dataclass(frozen=True)
class FreeGaussians:
    """``F`` Gaussians with attributes of their own, before activation.

    Args:
        means: ``[F, 3]`` scene units.
        log_scales: ``[F, 3]``.
        quats: ``[F, 4]`` wxyz, normalised when drawn.
        logit_opacities: ``[F]``.
        colors: ``[F, 3]`` sRGB, independent of the view direction.
        births: ``[F]`` int64 identities, assigned when a Gaussian is spawned; ascending, each used once in a stream.
    """

    means: Tensor
    log_scales: Tensor
    quats: Tensor
    logit_opacities: Tensor
    colors: Tensor
    births: Tensor

    def __len__(self) -> int:
        return self.means.shape[0]

    @classmethod
    def empty(cls, like: Tensor | None = None) -> "FreeGaussians":
        """Zero free Gaussians, with the dtype and device of ``like``."""
        like = torch.zeros(0) if like is None else like
        return cls(
            means=like.new_zeros(0, 3),
            log_scales=like.new_zeros(0, 3),
            quats=like.new_zeros(0, 4),
            logit_opacities=like.new_zeros(0),
            colors=like.new_zeros(0, 3),
            births=torch.zeros(0, dtype=torch.int64, device=like.device),
        )

    @classmethod
    def spawned(
        cls, means: Tensor, log_scales: Tensor, colors: Tensor, *, opacity: float, first_identity: int
    ) -> "FreeGaussians":
        """New ones of one ``opacity``, without rotation, whose identities count from ``first_identity``."""
        count = len(means)
        return cls(
            means=means,
            log_scales=log_scales,
            quats=means.new_tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
            logit_opacities=torch.logit(torch.tensor(opacity)).to(means).repeat(count),
            colors=colors,
            births=first_identity + torch.arange(count, device=means.device),
        )

    def select(self, rows: Tensor) -> "FreeGaussians":
        """The rows of a mask ``[F]`` or of indices ``[f]``."""
        rows = row_indices(rows, self.means)
        return FreeGaussians(**{name: column[rows] for name, column in vars(self).items()})

    def to(self, device: torch.device) -> "FreeGaussians":
        """The same on ``device``."""
        return FreeGaussians(**{name: column.to(device) for name, column in vars(self).items()})

    def append(self, other: "FreeGaussians") -> "FreeGaussians":
        """These rows, then those of ``other``."""
        return FreeGaussians(**{name: torch.cat([rows, getattr(other, name)]) for name, rows in vars(self).items()})

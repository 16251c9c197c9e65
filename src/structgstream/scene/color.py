# SPDX-License-Identifier: Apache-2.0
"""Per-camera affine colour: real rigs differ in exposure and white balance."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class CameraColor:
    """A gain and a bias per training camera and channel: ``picture = gain * rendering + bias``.

    Args:
        gains: ``[V, 3]``, mean one over the cameras.
        biases: ``[V, 3]``, mean zero over the cameras.

    Note [Colour gauge]
    ~~~~~~~~~~~~~~~~~~~
    A gain common to all cameras and the scene's colours are ambiguous. The gauge is fixed by making the training
    cameras' mean correction exactly the identity. Held-out cameras, for which no correction may be fitted, render with
    that mean. A penalty would only slow a drift, because the loss is invariant to a common gain.
    """

    gains: Tensor
    biases: Tensor

    @classmethod
    def identity(cls, cameras: int, like: Tensor | None = None) -> "CameraColor":
        """No correction for ``cameras`` cameras."""
        like = torch.zeros(0) if like is None else like
        return cls(gains=like.new_ones(cameras, 3), biases=like.new_zeros(cameras, 3))

    def of_cameras(self, rows: Sequence[int]) -> "CameraColor":
        """The correction of the cameras ``rows``."""
        indices = torch.tensor(rows, device=self.gains.device)
        return CameraColor(self.gains[indices], self.biases[indices])

    def gauged(self) -> "CameraColor":
        """The correction in the gauge of Note [Colour gauge]; differentiable."""
        return CameraColor(
            gains=self.gains - self.gains.mean(0) + 1.0,
            biases=self.biases - self.biases.mean(0),
        )

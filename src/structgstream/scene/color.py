# SPDX-License-Identifier: Apache-2.0
"""Per-camera affine colour: real rigs differ in exposure and white balance."""

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class CameraColor:
    """A gain and a bias for each training camera and channel: ``picture = gain * rendering + bias``.

    Args:
        gains: ``[V, 3]``, mean one over the cameras.
        biases: ``[V, 3]``, mean zero over the cameras.

    Note [Colour gauge]
    ~~~~~~~~~~~~~~~~~~~
    A common gain could move into the scene's colours and back, so the split is fixed: the training cameras' mean
    correction is the identity, exactly. Held-out cameras, of which nothing may be learned, render with that mean. A
    soft penalty would only slow the drift, for the loss does not see a common gain at all.
    """

    gains: Tensor
    biases: Tensor

    @classmethod
    def identity(cls, cameras: int, like: Tensor | None = None) -> "CameraColor":
        """No correction for ``cameras`` cameras."""
        like = torch.zeros(0) if like is None else like
        return cls(gains=like.new_ones(cameras, 3), biases=like.new_zeros(cameras, 3))

    def gauged(self) -> "CameraColor":
        """The correction with the gauge of Note [Colour gauge] applied; differentiable."""
        return CameraColor(
            gains=self.gains - self.gains.mean(0) + 1.0,
            biases=self.biases - self.biases.mean(0),
        )

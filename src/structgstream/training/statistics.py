# SPDX-License-Identifier: Apache-2.0
"""View-space positional gradients, collected by id.

Note [View-space units]
~~~~~~~~~~~~~~~~~~~~~~~
A rasteriser's ``screen_offsets`` are pixels. The thresholds of the literature (0.0002 for growing, the paper's
tau_grad = 0.001) are in normalised device coordinates, which span 2 over a picture: a gradient per pixel times half the
picture's size. This module is the only place that converts.
"""

import torch
from torch import Tensor

from structgstream.scene.render import Rendering


class GradientStatistics:
    """Sum and count of the gradient norm for each of ``slots`` ids (Note [Ids])."""

    def __init__(self, slots: int, device: torch.device) -> None:
        self.total = torch.zeros(slots, device=device)
        self.count = torch.zeros(slots, device=device)

    def add(self, rendering: Rendering, gradient: Tensor) -> None:
        """Add one rendering's ``screen_offsets`` gradient ``[N, 2]`` (pixels) for the Gaussians that were drawn."""
        height, width = rendering.alpha.shape
        x, y = gradient.unbind(1)
        length = ((0.5 * width * x).square_() + (0.5 * height * y).square_()).sqrt_()
        drawn = (rendering.radii > 0).to(length)
        # An id occurs once a rendering, so sums repeat bit for bit.
        ids = rendering.gaussians.ids
        self.total.index_add_(0, ids, length * drawn)
        self.count.index_add_(0, ids, drawn)

    def mean(self) -> Tensor:
        """Mean gradient norm of each slot, ``[slots]`` in NDC; 0 if it was never drawn."""
        return self.total / self.count.clamp(min=1.0)

# SPDX-License-Identifier: Apache-2.0
"""What every rasteriser returns."""

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class RasterOutput:
    """One rendering.

    Args:
        image: ``[H, W, 3]``, not clamped.
        alpha: ``[H, W]`` coverage in [0, 1].
        radii: ``[N]`` float32 pixels, 0 where a Gaussian was not drawn.
    """

    image: Tensor
    alpha: Tensor
    radii: Tensor

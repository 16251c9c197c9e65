# SPDX-License-Identifier: Apache-2.0
"""The pictures of one time step of a capture."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class MultiViewFrame:
    """The pictures of all cameras at one time step.

    Args:
        index: position in the stream, 0 for the first reconstructed frame.
        pts_seconds: presentation time, 0 for the first reconstructed frame.
        images: camera name to ``[H, W, 3]`` uint8 sRGB; sizes may differ between cameras. Held-out cameras are
            included when the source delivers them; training never reads them.
    """

    index: int
    pts_seconds: float
    images: Mapping[str, NDArray[np.uint8]]

    def __repr__(self) -> str:
        shapes = sorted({image.shape for image in self.images.values()})
        return f"MultiViewFrame(index={self.index}, pts_seconds={self.pts_seconds:.4f}, {len(self.images)} x {shapes})"

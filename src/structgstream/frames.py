# SPDX-License-Identifier: Apache-2.0
"""The pictures of one time step of a capture."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class MultiViewFrame:
    """The pictures of one time step; a camera without a picture is absent from it.

    Args:
        index: position in the stream, 0 for the first reconstructed frame.
        pts_seconds: presentation time, 0 for the first reconstructed frame.
        images: camera name to ``[H, W, 3]`` uint8 sRGB, in the rig's order; sizes may differ between cameras. Cameras
            that have no picture of this instant are missing here. Held-out cameras are included when the source
            delivers them; training never reads them.
        masks: camera name to ``[H, W]`` bool, True where the picture counts. A camera that is missing here counts
            everywhere.
        captured_unix_seconds: when it was filmed, Unix time, if the cameras are live.
        mean_of: number of pictures that a training pixel is the mean of, on average (``data/denoising.py``).
    """

    index: int
    pts_seconds: float
    images: Mapping[str, NDArray[np.uint8]]
    masks: Mapping[str, NDArray[np.bool_]] = field(default_factory=dict)
    captured_unix_seconds: float | None = None
    mean_of: float = 1.0

    def present(self, names: Iterable[str]) -> tuple[str, ...]:
        """Those of the cameras ``names`` whose picture counts somewhere, in their order."""
        return tuple(
            name for name in names if name in self.images and (name not in self.masks or self.masks[name].any())
        )

    def __repr__(self) -> str:
        shapes = sorted({image.shape for image in self.images.values()})
        return f"MultiViewFrame(index={self.index}, pts_seconds={self.pts_seconds:.4f}, {len(self.images)} x {shapes})"

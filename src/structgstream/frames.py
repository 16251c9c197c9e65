# SPDX-License-Identifier: Apache-2.0
"""The pictures of one time step of a capture."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

LEAST_CAMERAS = 2
"""Training cameras that a frame needs: one picture does not say where things are."""
BLANK_LEVELS = 2.0
"""Standard deviation, in levels of 255, below which a picture shows nothing: a covered lens, a camera that starts."""
MOST_BLANK_SHARE = 0.25
"""Share of frame 0's pictures that may be blank while the others are not; if more are, the scene is dark or plain."""
_EVERY_PIXELS = 8  # A picture that shows something does so in every eighth row and column.


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

    def showing(self, names: Iterable[str]) -> tuple[str, ...]:
        """Those of :meth:`present` whose picture shows something; in frame 0 all of them if many show nothing.

        Later many pictures are blank at once where what records them fails, or the light is off.
        """
        present = self.present(names)
        blank = [name for name in present if self._is_blank(name)]
        if self.index == 0 and len(blank) > MOST_BLANK_SHARE * len(present):
            return present
        return tuple(name for name in present if name not in blank)

    def _is_blank(self, name: str) -> bool:
        sample = (slice(None, None, _EVERY_PIXELS), slice(None, None, _EVERY_PIXELS))
        pixels = self.images[name][sample]
        if name in self.masks:
            pixels = pixels[self.masks[name][sample]]
        return pixels.size > 0 and float(pixels.reshape(-1, 3).std(0).max()) < BLANK_LEVELS

    def __repr__(self) -> str:
        shapes = sorted({image.shape for image in self.images.values()})
        return f"MultiViewFrame(index={self.index}, pts_seconds={self.pts_seconds:.4f}, {len(self.images)} x {shapes})"

# SPDX-License-Identifier: Apache-2.0
"""Which pixels of a camera show something other than in the first frame.

Nine pixels in ten of a usual capture show what stands still, so a mean over all pixels hides how well motion
is reconstructed. Changed pixels are found in the camera's own pictures, never in renderings.
"""

import numpy as np
from numpy.typing import NDArray

THRESHOLD = 0.1  # of full scale
SMOOTHED, GROWN = 1, 3  # half widths in pixels: a 3x3 mean against noise, a 7x7 dilation to hold the edges


def changed_pixels(truth: NDArray[np.uint8], first: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Mask ``[H, W]`` of the pixels that show something other than in the camera's first picture.

    The absolute difference of the two pictures ``[H, W, 3]``, averaged over channels and 3x3 pixels, exceeds
    0.1 of full scale somewhere within 3 pixels.
    """
    difference = np.abs(truth.astype(np.float32) - first.astype(np.float32)).mean(axis=2) / 255.0
    height, width = difference.shape
    padded = np.pad(difference, SMOOTHED, mode="edge")
    windows = 2 * SMOOTHED + 1
    shifted = [padded[y : y + height, x : x + width] for y in range(windows) for x in range(windows)]
    return grown(np.mean(shifted, axis=0) > THRESHOLD, GROWN)


def grown(mask: NDArray[np.bool_], pixels: int) -> NDArray[np.bool_]:
    """``mask`` ``[H, W]`` dilated by a square that reaches ``pixels`` to each side."""
    height, width = mask.shape
    padded = np.pad(mask, ((0, 0), (pixels, pixels)))
    across = np.any([padded[:, x : x + width] for x in range(2 * pixels + 1)], axis=0)
    padded = np.pad(across, ((pixels, pixels), (0, 0)))
    return np.any([padded[y : y + height] for y in range(2 * pixels + 1)], axis=0)

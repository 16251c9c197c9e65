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
    # Sums of integers: exact, and half the memory of floats.
    channels = np.abs(np.subtract(truth, first, dtype=np.int16))
    difference = channels[..., 0] + channels[..., 1] + channels[..., 2]
    padded = np.pad(difference, SMOOTHED, mode="edge")
    height, width = difference.shape
    size = 2 * SMOOTHED + 1
    across = sum((padded[:, x : x + width] for x in range(1, size)), start=padded[:, :width])
    total = sum((across[y : y + height] for y in range(1, size)), start=across[:height])
    return dilate(total > THRESHOLD * (255 * 3 * size**2), GROWN)


def dilate(mask: NDArray[np.bool_], pixels: int) -> NDArray[np.bool_]:
    """``mask`` ``[H, W]`` dilated by a square that reaches ``pixels`` to each side."""
    return _dilate_down(_dilate_down(mask, pixels).T, pixels).T


def _dilate_down(mask: NDArray[np.bool_], pixels: int) -> NDArray[np.bool_]:
    result = mask.copy()
    for step in range(1, pixels + 1):
        result[step:] |= mask[:-step]
        result[:-step] |= mask[step:]
    return result

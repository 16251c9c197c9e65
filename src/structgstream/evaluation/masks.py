# SPDX-License-Identifier: Apache-2.0
"""Masks of pixels that changed since the first frame, and of pixels that count.

In typical captures nine of ten pixels are static, so a mean over all pixels hides the quality of moving parts. Masks
are computed from the camera's pictures, never from renderings.
"""

import math

import numpy as np
from numpy.typing import NDArray

from structgstream.cameras import enlargement

THRESHOLD = 0.1  # of full scale
SMOOTHED = 1  # half width, pixels, of a 3x3 mean against noise, which does not depend on the picture's size
REACH_PIXELS = 3  # of the dilation, which includes edges; multiplied by the picture's enlargement


def blackened(picture: NDArray[np.uint8], mask: NDArray[np.bool_] | None) -> NDArray[np.uint8]:
    """``picture`` ``[H, W, 3]``, black where the mask ``[H, W]`` is False; unchanged without a mask."""
    return picture if mask is None else np.where(mask[..., None], picture, np.uint8(0))


def both(mask: NDArray[np.bool_] | None, other: NDArray[np.bool_] | None) -> NDArray[np.bool_] | None:
    """Pixels of both masks; None for all."""
    if mask is None or other is None:
        return other if mask is None else mask
    return mask & other


def changed_pixels(
    truth: NDArray[np.uint8], first: NDArray[np.uint8], mask: NDArray[np.bool_] | None = None
) -> NDArray[np.bool_]:
    """Dilated mask ``[H, W]`` of the pixels that changed since the camera's first picture.

    The absolute difference of the two pictures ``[H, W, 3]``, averaged over channels and 3x3 pixels, is thresholded at
    0.1 of full scale, and the mask dilated by 3 pixels of a picture of the reference size
    (:func:`structgstream.cameras.enlargement`). Pixels outside ``mask`` count as not changed.
    """
    if mask is not None:
        return changed_pixels(blackened(truth, mask), blackened(first, mask)) & mask
    height, width = truth.shape[:2]
    reach = math.floor(REACH_PIXELS * enlargement(width, height) + 0.5)
    return dilate(differing(truth, first, THRESHOLD * 255), reach)


def differing(one: NDArray[np.uint8], other: NDArray[np.uint8], levels: float) -> NDArray[np.bool_]:
    """Mask ``[H, W]`` of the pixels where two pictures ``[H, W, 3]`` differ by more than ``levels`` of 255.

    The absolute difference is averaged over channels and 3x3 pixels.
    """
    # Sums of integers: exact, and half the memory of floats.
    channels = np.abs(np.subtract(one, other, dtype=np.int16))
    difference = channels[..., 0] + channels[..., 1] + channels[..., 2]
    padded = np.pad(difference, SMOOTHED, mode="edge")
    height, width = difference.shape
    size = 2 * SMOOTHED + 1
    across = sum((padded[:, x : x + width] for x in range(1, size)), start=padded[:, :width])
    total = sum((across[y : y + height] for y in range(1, size)), start=across[:height])
    return total > levels * (3 * size**2)


def dilate(mask: NDArray[np.bool_], pixels: int) -> NDArray[np.bool_]:
    """``mask`` ``[H, W]`` dilated by a square that reaches ``pixels`` to each side."""
    return _dilate_down(_dilate_down(mask, pixels).T, pixels).T


def _dilate_down(mask: NDArray[np.bool_], pixels: int) -> NDArray[np.bool_]:
    result = mask.copy()
    for step in range(1, pixels + 1):
        result[step:] |= mask[:-step]
        result[:-step] |= mask[step:]
    return result

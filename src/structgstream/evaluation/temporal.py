# SPDX-License-Identifier: Apache-2.0
"""Temporal consistency of a rendered video, from consecutive frames of one camera and the optical flow between them.

Synthetic captures may provide exact flow: any :data:`Flow`.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from structgstream.flow import consistency_mask, dis_search, sampled


@dataclass(frozen=True)
class FlowField:
    """Backward flow of one frame.

    Args:
        offsets: ``[H, W, 2]`` float32, x and y in pixels: pixel ``p`` was at ``p + offsets[p]`` in the frame before.
        seen: ``[H, W]`` mask of the pixels that were not occluded in the frame before.
    """

    offsets: NDArray[np.float32]
    seen: NDArray[np.bool_]


Flow = Callable[[NDArray[np.uint8], NDArray[np.uint8], str, int], FlowField]
"""From truth of the previous frame, truth of this frame, camera name and frame number to this frame's flow field."""


def dis_flow() -> Flow:
    """Flow by dense inverse search in both directions; consistent pixels (``flow.consistency_mask``) count as seen.

    Raises:
        MissingExtraError: OpenCV is not installed.
    """
    search = dis_search("eval")

    def field(before: NDArray[np.uint8], now: NDArray[np.uint8], camera: str, index: int) -> FlowField:
        backward = search(now, before)
        return FlowField(backward, consistency_mask(backward, search(before, now)))

    return field


Picture = NDArray[np.uint8]


def warping_error(now: Picture, before: Picture, field: FlowField) -> float | None:
    """E_warp of one pair: the mean squared difference of a rendering and the warped previous rendering.

    ``before`` is warped by the truth's backward flow; the mean is over channels and over the pixels that were not
    occluded. Pictures are ``[H, W, 3]`` uint8, full scale 1. None if all pixels were occluded.

    Source: Lai et al., 2018, whose sum over channels is a mean here.
    """
    if not field.seen.any():
        return None
    carried = sampled(before.astype(np.float32), field.offsets)
    squares = np.square(carried - now)[field.seen]
    return float(squares.mean(dtype=np.float64)) / 255.0**2


def difference_of_change(rendered: float, true: float) -> float:
    """Difference between the frame-to-frame change of rendering and truth, both by the same picture distance.

    With LPIPS this is tLP (Chu et al., 2020): ``|LPIPS(r_t, r_{t-1}) - LPIPS(g_t, g_{t-1})|``.
    """
    return abs(rendered - true)


def flicker(now: Picture, before: Picture, still: NDArray[np.bool_]) -> float | None:
    """Mean absolute difference of two consecutive pictures over the static pixels ``still`` ``[H, W]``, in levels of
    1/255.

    None without static pixels.
    """
    count = int(np.count_nonzero(still))
    if not count:
        return None
    difference = np.abs(np.subtract(now, before, dtype=np.int16)).sum(2, dtype=np.int32)
    return int(np.sum(difference, where=still, dtype=np.int64)) / (3 * count)

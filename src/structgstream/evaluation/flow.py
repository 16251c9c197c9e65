# SPDX-License-Identifier: Apache-2.0
"""Backward optical flow between consecutive pictures of one camera.

Synthetic captures may provide exact flow instead: any :data:`Flow`.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from structgstream.flow import consistency_mask, dis_search


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

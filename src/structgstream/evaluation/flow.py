# SPDX-License-Identifier: Apache-2.0
"""Where each pixel of a frame was in the frame before, from the camera's own pictures.

A capture that knows its motion (a synthetic one) gives exact fields in place of the estimated ones: anything that is a
:data:`Flow` will do.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from structgstream.flow import consistency_mask, dis_search


@dataclass(frozen=True)
class FlowField:
    """Where the pixels of one frame were in the frame before.

    Args:
        offsets: ``[H, W, 2]`` float32, x and y in pixels: pixel ``p`` was at ``p + offsets[p]``.
        seen: ``[H, W]`` whether what the pixel shows was in the frame before.
    """

    offsets: NDArray[np.float32]
    seen: NDArray[np.bool_]


Flow = Callable[[NDArray[np.uint8], NDArray[np.uint8], str, int], FlowField]
"""Truth of the frame before, truth of this frame, camera name, number of this frame; gives the field of this frame."""


def dis_flow() -> Flow:
    """Flow by dense inverse search, estimated both ways; a pixel counts as seen if ``flow.consistency_mask`` says so.

    Raises:
        MissingExtraError: OpenCV is not installed.
    """
    search = dis_search("eval")

    def field(before: NDArray[np.uint8], now: NDArray[np.uint8], camera: str, index: int) -> FlowField:
        backward = search(now, before)
        return FlowField(backward, consistency_mask(backward, search(before, now)))

    return field

# SPDX-License-Identifier: Apache-2.0
"""Where each pixel of a frame was in the frame before, from the camera's own pictures.

A capture that knows its motion (a synthetic one) gives exact fields in place of the estimated ones: anything that is a
:data:`Flow` will do.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import grid_sample

from structgstream.errors import MissingExtraError

RELATIVE, ABSOLUTE = 0.01, 0.5  # of the check for occlusion: a share of the squared lengths, and squared pixels


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
    """Flow by dense inverse search (Kroeger et al., 2016), OpenCV's preset "medium", on grey pictures.

    It is estimated both ways, and a pixel counts as seen if :func:`agreeing` says so.

    Raises:
        MissingExtraError: OpenCV is not installed.
    """
    try:
        import cv2
    except ImportError:
        raise MissingExtraError("cv2", "eval") from None
    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)

    def field(before: NDArray[np.uint8], now: NDArray[np.uint8], camera: str, index: int) -> FlowField:
        earlier, later = (cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) for picture in (before, now))
        # calc goes on from the flow that it is given, and writes into it.
        zeros = np.zeros((*earlier.shape, 2), np.float32)
        backward = np.asarray(search.calc(later, earlier, zeros.copy()), np.float32)
        forward = np.asarray(search.calc(earlier, later, zeros), np.float32)
        return FlowField(backward, agreeing(backward, forward))

    return field


def agreeing(backward: NDArray[np.float32], forward: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Which pixels ``[H, W]`` lead back to themselves, so that they are not occluded (Sundaram et al., 2010).

    With ``b`` the flow of this frame to the one before and ``f`` the one of that frame to this, ``[H, W, 2]``:
    ``|b(p) + f(p + b(p))|^2 <= 0.01 (|b(p)|^2 + |f(p + b(p))|^2) + 0.5``, and ``p + b(p)`` lies in the picture.
    """
    back = sampled(forward, backward)
    rest = np.square(backward + back).sum(2)
    lengths = np.square(backward).sum(2) + np.square(back).sum(2)
    return (rest <= RELATIVE * lengths + ABSOLUTE) & inside(backward)


def inside(offsets: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Which pixels ``[H, W]`` lead to a place between the centres of the picture's outermost pixels."""
    height, width, _ = offsets.shape
    x, y = offsets[..., 0] + np.arange(width), offsets[..., 1] + np.arange(height)[:, None]
    return (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)


def sampled(values: NDArray[np.float32], offsets: NDArray[np.float32]) -> NDArray[np.float32]:
    """``values`` ``[H, W, C]`` at each pixel plus its offset, of the same shape: bilinear, border repeated."""
    height, width, _ = offsets.shape
    x = (torch.from_numpy(offsets[..., 0]) + torch.arange(width)) * (2 / max(width - 1, 1)) - 1
    y = (torch.from_numpy(offsets[..., 1]) + torch.arange(height)[:, None]) * (2 / max(height - 1, 1)) - 1
    planes: Tensor = torch.from_numpy(np.ascontiguousarray(values)).permute(2, 0, 1)[None]
    grid = torch.stack([x, y], -1)[None]
    result = grid_sample(planes, grid, mode="bilinear", padding_mode="border", align_corners=True)
    return result[0].permute(1, 2, 0).numpy()

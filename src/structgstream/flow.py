# SPDX-License-Identifier: Apache-2.0
"""Optical flow between two pictures of one camera, and its forward-backward consistency."""

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import grid_sample

from structgstream.errors import MissingExtraError

RELATIVE, ABSOLUTE = 0.01, 0.5  # thresholds of the consistency check: share of squared lengths; squared pixels

FlowSearch = Callable[[NDArray[np.uint8], NDArray[np.uint8]], NDArray[np.float32]]
"""From two pictures ``[H, W, 3]`` of one size to flow ``[H, W, 2]``, x and y in pixels: pixel ``p`` of the first
picture corresponds to ``p + flow[p]`` in the second."""


def dis_search(extra: str, *, refined: bool = True, finest_level: int = 1) -> FlowSearch:
    """Flow by dense inverse search (Kroeger et al., 2016) on grey pictures.

    Args:
        extra: the extra of this package that a user should install when OpenCV is missing.
        refined: OpenCV's preset "medium". False: preset "fast", stopped at half resolution and without variational
            refinement; it takes two fifths of the time and is as accurate at consistent
            pixels (:func:`consistency_mask`).
        finest_level: of the pyramid, if not refined: 1 is half resolution, 0 full.

    Raises:
        MissingExtraError: OpenCV is not installed.
    """
    try:
        import cv2
    except ImportError:
        raise MissingExtraError("cv2", extra) from None
    preset = cv2.DISOPTICAL_FLOW_PRESET_MEDIUM if refined else cv2.DISOPTICAL_FLOW_PRESET_FAST
    search = cv2.DISOpticalFlow.create(preset)
    if not refined:
        search.setFinestScale(finest_level)
        search.setVariationalRefinementIterations(0)

    def flow(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> NDArray[np.float32]:
        one, other = (cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) for picture in (first, second))
        # calc starts from the flow that it is given and overwrites it.
        return np.asarray(search.calc(one, other, np.zeros((*one.shape, 2), np.float32)), np.float32)

    return flow


def picture_shift(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> tuple[float, float]:
    """How far ``second`` is shifted as a whole against ``first`` ``[H, W, 3]``, in pixels, and how clearly, 0 to 1:
    phase correlation (Kuglin and Hines, 1975) of grey pictures under a Hann window.

    Raises:
        MissingExtraError: OpenCV is not installed.
    """
    try:
        import cv2
    except ImportError:
        raise MissingExtraError("cv2", "capture") from None
    one, other = (cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(np.float32) for picture in (first, second))
    height, width = one.shape
    if min(height, width) < 2:
        return 0.0, 0.0
    (x, y), clarity = cv2.phaseCorrelate(one, other, cv2.createHanningWindow((width, height), cv2.CV_32F))
    return float(np.hypot(x, y)), float(clarity)


def consistency_mask(flow: NDArray[np.float32], back: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Mask ``[H, W]`` of the pixels whose flow is forward-backward consistent, hence not occluded (Sundaram et al.,
    2010).

    With ``f`` the forward and ``b`` the backward flow, ``[H, W, 2]``:
    ``|f(p) + b(p + f(p))|^2 <= 0.01 (|f(p)|^2 + |b(p + f(p))|^2) + 0.5``, and ``p + f(p)`` lies in the picture.
    """
    returned = sampled(back, flow)
    rest = _squared_lengths(flow + returned)
    lengths = _squared_lengths(flow) + _squared_lengths(returned)
    return (rest <= RELATIVE * lengths + ABSOLUTE) & inside(flow)


def _squared_lengths(vectors: NDArray[np.float32]) -> NDArray[np.float32]:
    # numpy sums over a short last axis take five times as long.
    return np.square(vectors[..., 0]) + np.square(vectors[..., 1])


def inside(offsets: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Mask ``[H, W]`` of the pixels that their offset moves to a position inside the outermost pixel centres."""
    height, width, _ = offsets.shape
    columns, rows = np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)
    x, y = offsets[..., 0] + columns, offsets[..., 1] + rows[:, None]
    return (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)


def sampled(values: NDArray[np.float32], offsets: NDArray[np.float32]) -> NDArray[np.float32]:
    """``values`` ``[H, W, C]`` sampled at each pixel plus its offset, same shape: bilinear, border repeated."""
    height, width, _ = offsets.shape
    x = (torch.from_numpy(offsets[..., 0]) + torch.arange(width)) * (2 / max(width - 1, 1)) - 1
    y = (torch.from_numpy(offsets[..., 1]) + torch.arange(height)[:, None]) * (2 / max(height - 1, 1)) - 1
    planes: Tensor = torch.from_numpy(np.ascontiguousarray(values)).permute(2, 0, 1)[None]
    grid = torch.stack([x, y], -1)[None]
    result = grid_sample(planes, grid, mode="bilinear", padding_mode="border", align_corners=True)
    return result[0].permute(1, 2, 0).numpy()

# SPDX-License-Identifier: Apache-2.0
"""Temporal consistency of a rendered video, from consecutive frames of one camera."""

import numpy as np
from numpy.typing import NDArray

from structgstream.evaluation.flow import FlowField
from structgstream.flow import sampled

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

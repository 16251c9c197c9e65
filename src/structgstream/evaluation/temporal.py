# SPDX-License-Identifier: Apache-2.0
"""How steady a rendered video is: two consecutive frames of one camera at a time."""

import numpy as np
from numpy.typing import NDArray

from structgstream.evaluation.flow import FlowField
from structgstream.flow import sampled

Picture = NDArray[np.uint8]


def warping_error(now: Picture, before: Picture, field: FlowField) -> float | None:
    """E_warp of one pair: the mean squared difference of a rendering and the one before it carried along.

    ``before`` is sampled where the truth's flow says that each pixel was; the mean runs over channels and over the
    pixels that were seen there. Pictures ``[H, W, 3]`` uint8 count as [0, 1]. None where no pixel was seen.

    Source: Lai et al., 2018, whose sum over channels is a mean here.
    """
    if not field.seen.any():
        return None
    carried = sampled(before.astype(np.float32), field.offsets)
    squares = np.square(carried - now)[field.seen]
    return float(squares.mean(dtype=np.float64)) / 255.0**2


def difference_of_change(rendered: float, true: float) -> float:
    """How far the change from frame to frame is from the truth's, both by one distance of pictures.

    With LPIPS this is tLP (Chu et al., 2020): ``|LPIPS(r_t, r_{t-1}) - LPIPS(g_t, g_{t-1})|``.
    """
    return abs(rendered - true)


def flicker(now: Picture, before: Picture, still: NDArray[np.bool_]) -> float | None:
    """Mean absolute difference of two consecutive pictures over the ``still`` pixels ``[H, W]``, in levels of 1/255.

    None where nothing is still.
    """
    count = int(np.count_nonzero(still))
    if not count:
        return None
    difference = np.abs(np.subtract(now, before, dtype=np.int16)).sum(2, dtype=np.int32)
    return int(np.sum(difference, where=still, dtype=np.int64)) / (3 * count)

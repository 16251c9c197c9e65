# SPDX-License-Identifier: Apache-2.0
"""Matches of descriptors: each other's nearest, and clearly nearer than the next one.

The comparison with the next one is the ratio test of Lowe, Distinctive image features from scale-invariant keypoints,
IJCV 2004, section 7.1.
"""

import math

import numpy as np
from numpy.typing import NDArray

BLOCK = 2048
OPPOSITE = -1.0  # the cosine of descriptors that are as far apart as can be


def mutual_matches(
    first: NDArray[np.float32],
    second: NDArray[np.float32],
    *,
    ratio: float,
    distance: float = math.inf,
    seen: tuple[NDArray[np.bool_], NDArray[np.bool_]] | None = None,
) -> NDArray[np.intp]:
    """Matches ``[S, 2]`` of unit descriptors ``[N, D]`` and ``[M, D]``, as rows of both, ascending in the first.

    Args:
        ratio: largest ratio of the distances from a descriptor of the first list to its nearest and to its second
            nearest of the second list.
        distance: largest distance of a match; unit descriptors without negative entries are at most sqrt(2) apart.
        seen: ``[N, T]`` and ``[M, T]``, at which instants; only those that share one may match. All may without it.
    """
    if len(first) < 2 or len(second) < 2:
        return np.empty((0, 2), np.intp)
    nearest, distinct = np.zeros(len(first), np.intp), np.zeros(len(first), bool)
    nearest_value, most = np.empty(len(first), np.float32), np.full(len(second), -np.inf, np.float32)
    bits = None if seen is None else tuple(np.packbits(part, axis=1) for part in seen)
    for start in range(0, len(first), BLOCK):  # all products at once would be gigabytes
        rows = slice(start, start + BLOCK)
        similarity = first[rows] @ second.T
        if bits is not None:
            # Eight times as quick as an assignment to a mask.
            similarity -= _never_together(bits[0][rows], bits[1]) * np.float32(2)
            np.maximum(similarity, OPPOSITE, out=similarity)
        # The largest values say which matches are mutual; where they are along the first axis costs ten times as much.
        np.maximum(most, similarity.max(0), out=most)
        nearest[rows], nearest_value[rows], distinct[rows] = _distinct_nearest(similarity, ratio, distance)
    kept = np.flatnonzero(distinct & (nearest_value == most[nearest]))
    _, once = np.unique(nearest[kept], return_index=True)  # equal descriptors of the first list are equally near
    kept = np.sort(kept[once])
    return np.stack([kept, nearest[kept]], 1)


def _never_together(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """``[N, M]``, where rows ``[N, B]`` and ``[M, B]`` of bits have none in common."""
    apart = np.ones((len(first), len(second)), bool)
    for one, two in zip(first.T, second.T, strict=True):
        apart &= (one[:, None] & two) == 0
    return apart


def _distinct_nearest(
    similarity: NDArray[np.float32], ratio: float, distance: float
) -> tuple[NDArray[np.intp], NDArray[np.float32], NDArray[np.bool_]]:
    """For each row the column of the largest value, this, and whether it stands out. Changes ``similarity``."""
    lines = np.arange(len(similarity))
    nearest = similarity.argmax(1)
    top = similarity[lines, nearest]
    similarity[lines, nearest] = OPPOSITE
    next_best = similarity.max(1)
    apart, further = (np.sqrt(np.maximum(2 - 2 * value, 0)) for value in (top, next_best))
    return nearest, top, (apart < ratio * further) & (apart < distance)

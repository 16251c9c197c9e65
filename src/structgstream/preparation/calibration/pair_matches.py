# SPDX-License-Identifier: Apache-2.0
"""Matches of keypoints between pairs of cameras, found without poses."""

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from structgstream.preparation.calibration.keypoints import Keypoints

BLOCK = 2048


@dataclass(frozen=True)
class MatchConfig:
    """How keypoints of two cameras are matched.

    Args:
        ratio: largest ratio of the best to the second-best descriptor distance.
        distance: largest descriptor distance of a match; unit descriptors are at most sqrt(2) apart.
    """

    ratio: float = 0.85
    distance: float = 0.8


def mutual_matches(first: Keypoints, second: Keypoints, *, config: MatchConfig = MatchConfig()) -> NDArray[np.uint32]:
    """Mutually best matches ``[S, 2]``, indices into the two lists, of keypoints that share an instant."""
    if len(first) < 2 or len(second) < 2:
        return np.empty((0, 2), np.uint32)
    best, passes, back = _best(first, second, config)
    kept = np.flatnonzero(passes & (back[best] == np.arange(len(first))))
    return np.stack([kept, best[kept]], 1).astype(np.uint32)


def _best(
    query: Keypoints, others: Keypoints, config: MatchConfig
) -> tuple[NDArray[np.intp], NDArray[np.bool_], NDArray[np.intp]]:
    """For each keypoint of ``query`` the most alike of ``others`` and whether it stands out; and the reverse of the
    first, from the same products."""
    best = np.zeros(len(query), np.intp)
    passes = np.zeros(len(query), bool)
    back, most = np.zeros(len(others), np.intp), np.full(len(others), -np.inf, np.float32)
    everywhere = query.seen.shape[1] == 1
    there = others.seen.astype(np.float32).T
    for start in range(0, len(query), BLOCK):
        rows = slice(start, start + BLOCK)
        similarity = query.descriptors[rows] @ others.descriptors.T
        if not everywhere:
            similarity[query.seen[rows].astype(np.float32) @ there == 0] = -1.0
        likest = similarity.argmax(0)
        values = similarity[likest, np.arange(len(others))]
        back = np.where(values > most, start + likest, back)
        most = np.maximum(values, most)
        chosen = similarity.argmax(1)
        lines = np.arange(len(similarity))
        top = similarity[lines, chosen]
        similarity[lines, chosen] = -1.0
        next_best = similarity.max(1)
        apart, further = (np.sqrt(np.maximum(2 - 2 * value, 0)) for value in (top, next_best))
        best[rows] = chosen
        passes[rows] = (apart < config.ratio * further) & (apart < config.distance)
    return best, passes, back


def all_matches(
    keypoints: Mapping[str, Keypoints], *, workers: int, config: MatchConfig = MatchConfig()
) -> dict[tuple[str, str], NDArray[np.uint32]]:
    """:func:`mutual_matches` of every pair of cameras."""
    pairs = list(combinations(keypoints, 2))
    with ThreadPoolExecutor(workers) as pool:
        found = pool.map(lambda pair: mutual_matches(keypoints[pair[0]], keypoints[pair[1]], config=config), pairs)
        return dict(zip(pairs, found, strict=True))

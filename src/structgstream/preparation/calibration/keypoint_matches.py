# SPDX-License-Identifier: Apache-2.0
"""Matches of keypoints between pairs of cameras, found without poses."""

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from structgstream.data.descriptor_matches import mutual_matches
from structgstream.data.matching import Pair
from structgstream.preparation.calibration.keypoints import Keypoints


@dataclass(frozen=True)
class KeypointMatchConfig:
    """How keypoints of two cameras are matched.

    Args:
        ratio: largest ratio of the best to the second-best descriptor distance.
        distance: largest descriptor distance of a match; unit descriptors are at most sqrt(2) apart.
    """

    ratio: float = 0.85
    distance: float = 0.8


def keypoint_matches(
    first: Keypoints, second: Keypoints, *, config: KeypointMatchConfig = KeypointMatchConfig()
) -> NDArray[np.uint32]:
    """Mutually best matches ``[S, 2]``, indices into the two lists, of keypoints that share an instant."""
    seen = None if first.seen.shape[1] == 1 else (first.seen, second.seen)
    found = mutual_matches(
        first.descriptors, second.descriptors, ratio=config.ratio, distance=config.distance, seen=seen
    )
    return found.astype(np.uint32)


def all_matches(
    keypoints: Mapping[str, Keypoints], *, workers: int, config: KeypointMatchConfig = KeypointMatchConfig()
) -> dict[Pair, NDArray[np.uint32]]:
    """:func:`keypoint_matches` of every pair of cameras."""
    pairs = list(combinations(keypoints, 2))
    with ThreadPoolExecutor(workers) as pool:
        found = pool.map(lambda pair: keypoint_matches(keypoints[pair[0]], keypoints[pair[1]], config=config), pairs)
        return dict(zip(pairs, found, strict=True))

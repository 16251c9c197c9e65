# SPDX-License-Identifier: Apache-2.0
"""Matches between all pictures of one instant, found without the poses."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from structgstream.cameras import Camera
from structgstream.data.arrays import Floats
from structgstream.data.matching import Pair
from structgstream.data.pair_matches import PairError, PairMatcher, neighbor_pairs, pair_error
from structgstream.frames import MultiViewFrame

ALL_PAIRS = 32  # cameras; with more, only neighbours by the given poses are matched
NEIGHBOURS = 8


@dataclass(frozen=True)
class Evidence:
    """Keypoints and matches of one instant.

    Args:
        images: name of a camera to its picture ``[H, W, 3]``.
        keypoints: name of a camera to pixels ``[S, 2]``.
        matches: pair of cameras to numbers of keypoints ``[M, 2]``; empty where they see too little in common.
    """

    images: Mapping[str, NDArray[np.uint8]]
    keypoints: Mapping[str, Floats]
    matches: Mapping[Pair, NDArray[np.intp]]

    def pixels(self, pair: Pair) -> tuple[Floats, Floats]:
        """Matched pixels ``[M, 2]`` in both pictures."""
        rows = self.matches[pair]
        return self.keypoints[pair[0]][rows[:, 0]], self.keypoints[pair[1]][rows[:, 1]]

    def overlapping(self) -> list[Pair]:
        """Pairs with matches."""
        return [pair for pair, rows in self.matches.items() if len(rows)]


def gather(
    frame: MultiViewFrame,
    cameras: Mapping[str, Camera],
    *,
    matcher: PairMatcher | None = None,
    readings: Collection[Mapping[str, Camera]] = (),
) -> Evidence:
    """Matches of all pairs of a frame's pictures; of large rigs those of neighbours, by the cameras and by ``readings``
    of their poses.

    Args:
        frame: the pictures.
        cameras: as given.
        matcher: of the same pictures, where some pairs were matched before.
        readings: other poses of the same cameras.

    Raises:
        MissingExtraError: cv2 is not installed.
    """
    names = [name for name in cameras if name in frame.images]
    if len(names) <= ALL_PAIRS:
        pairs = list(combinations(names, 2))
    else:
        rigs = [{name: rig[name] for name in names} for rig in (cameras, *readings)]
        pairs = list(dict.fromkeys(pair for rig in rigs for pair in neighbor_pairs(rig, count=NEIGHBOURS)))
    matcher = matcher or PairMatcher(frame.images, masks=frame.masks)
    matches = matcher.indices(pairs)
    return Evidence(frame.images, {name: matcher.keypoints(name) for name in names if pairs}, matches)


def pair_errors(evidence: Evidence, cameras: Mapping[str, Camera]) -> dict[Pair, PairError]:
    """The error of every pair with matches."""
    return {
        pair: pair_error(cameras[pair[0]], cameras[pair[1]], *evidence.pixels(pair)) for pair in evidence.overlapping()
    }

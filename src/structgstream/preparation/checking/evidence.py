# SPDX-License-Identifier: Apache-2.0
"""Matches between all pictures of one instant, found without the poses."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from structgstream.cameras import Camera
from structgstream.data.arrays import Floats
from structgstream.data.matching import (
    Pair,
    angles,
    epipolar_errors,
    fundamental_matrix,
    neighbor_views,
    rays,
    triangulate,
    unique_pairs,
    viewing_distance,
)
from structgstream.data.pair_matches import MatchConfig, PairMatcher
from structgstream.frames import MultiViewFrame

ALL_PAIRS = 32  # cameras; with more, only neighbours by the given poses are matched
NEIGHBOURS = 8
MIN_PARALLAX_DEGREES = 0.3
VIOLATION_SHARE = 0.01  # of the picture's width


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


@dataclass(frozen=True)
class PairError:
    """How badly the poses explain the matches of a pair: a median in pixels, and the share of violating matches."""

    pixels: float
    share: float
    matches: int


def gather(frame: MultiViewFrame, cameras: Mapping[str, Camera], *, config: MatchConfig | None = None) -> Evidence:
    """Matches of all pairs of a frame's pictures, of neighbours only in large rigs.

    Raises:
        MissingExtraError: cv2 is not installed.
    """
    names = [name for name in cameras if name in frame.images]
    if len(names) <= ALL_PAIRS:
        pairs = list(combinations(names, 2))
    else:
        seen = {name: cameras[name] for name in names}
        pairs = unique_pairs(neighbor_views(seen, count=NEIGHBOURS, distance=viewing_distance(seen)))
    matcher = PairMatcher(frame.images, config or MatchConfig(), masks=frame.masks)
    matches = matcher.indices(pairs)
    return Evidence(frame.images, {name: matcher.keypoints(name) for name in names if pairs}, matches)


def pair_error(first: Camera, second: Camera, pixels1: Floats, pixels2: Floats) -> PairError:
    """Matches ``[M, 2]`` of one pair against the poses.

    A match violates them when it lies off its epipolar line, or is triangulated behind a camera: cameras that only
    differ in position keep their epipolar lines when they are inverted.
    """
    errors = epipolar_errors(fundamental_matrix(first, second), pixels1, pixels2)
    _, depths = triangulate(first, second, pixels1, pixels2)
    parallax = np.degrees(angles(rays(first, pixels1), rays(second, pixels2)))
    behind = (depths < 0).any(1) & (parallax > MIN_PARALLAX_DEGREES)
    violating = (errors > VIOLATION_SHARE * first.width) | behind
    return PairError(float(np.median(errors)), float(violating.mean()), len(errors))


def pair_errors(evidence: Evidence, cameras: Mapping[str, Camera]) -> dict[Pair, PairError]:
    """The error of every pair with matches."""
    return {
        pair: pair_error(cameras[pair[0]], cameras[pair[1]], *evidence.pixels(pair)) for pair in evidence.overlapping()
    }

# SPDX-License-Identifier: Apache-2.0
"""Keypoint matches between pictures, found without the poses, so that they can test the poses, and their errors.

Descriptors match if they are each other's nearest and pass the ratio test (Lowe, Distinctive image features from
scale-invariant keypoints, IJCV 2004, section 7.1).
"""

import math
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from structgstream.cameras import Camera, enlargement
from structgstream.data.arrays import Floats
from structgstream.data.images import opencv
from structgstream.data.matching import (
    Features,
    Pair,
    angles,
    epipolar_errors,
    fundamental_matrix,
    neighbor_views,
    rays,
    sift_features,
    triangulate,
    unique_pairs,
    viewing_distance,
)

KEYPOINT_SIDE = 2000
"""Longest side in pixels at which keypoints are found, for the time that larger pictures take. SIFT places a keypoint
within a third of a pixel, here 1/6000 of the side; the smallest error that the checks count is 1/1300 of the width
(``pose_check.verdicts.FLOOR_PIXELS``)."""
BLOCK = 2048
OPPOSITE = -1.0  # the cosine of descriptors at the largest distance
MIN_PARALLAX_DEGREES = 0.3  # between the rays of a match, from which a point behind a camera counts
VIOLATION_SHARE = 0.01  # of the picture's width
PAIR_SHARE = 0.3  # of a pair's matches that violate the poses: of right poses mostly 0 to 0.14, of wrong ones most
MAX_PAIRS = 200  # of neighbours: all of rigs up to 150 cameras, since a camera of which no pair is tested is unchecked


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
    mutual = np.flatnonzero(distinct & (nearest_value == most[nearest]))
    _, once = np.unique(nearest[mutual], return_index=True)  # equal descriptors of the first list are equally near
    mutual = np.sort(mutual[once])
    return np.stack([mutual, nearest[mutual]], 1)


def _never_together(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """``[N, M]``, where rows ``[N, B]`` and ``[M, B]`` of bits have none in common."""
    disjoint = np.ones((len(first), len(second)), bool)
    for one, two in zip(first.T, second.T, strict=True):
        disjoint &= (one[:, None] & two) == 0
    return disjoint


def _distinct_nearest(
    similarity: NDArray[np.float32], ratio: float, distance: float
) -> tuple[NDArray[np.intp], NDArray[np.float32], NDArray[np.bool_]]:
    """For each row the column of the largest value, this, and whether it stands out. Changes ``similarity``."""
    lines = np.arange(len(similarity))
    nearest = similarity.argmax(1)
    top = similarity[lines, nearest]
    similarity[lines, nearest] = OPPOSITE
    next_best = similarity.max(1)
    first_distance, second_distance = (np.sqrt(np.maximum(2 - 2 * value, 0)) for value in (top, next_best))
    return nearest, top, (first_distance < ratio * second_distance) & (first_distance < distance)


@dataclass(frozen=True)
class MatchConfig:
    """Thresholds of the matches.

    Args:
        features: SIFT keypoints per picture.
        ratio: largest ratio of the best to the second-best descriptor distance.
        inlier_pixels: largest epipolar distance of inliers of a pair's own epipolar geometry, in pixels of a picture of
            the reference size (``cameras.enlargement``).
        min_inliers: least number of inliers of a pair that is used.
        min_inlier_share: least share of inliers among the matches of a pair that is used.
    """

    features: int = 1500
    ratio: float = 0.75
    inlier_pixels: float = 1.5
    min_inliers: int = 20
    min_inlier_share: float = 0.5


class PairMatcher:
    """Matches of pairs of pictures that are inliers of some epipolar geometry (Hartley and Zisserman, Multiple View
    Geometry, chapter 11); results per picture and pair are cached.

    Args:
        images: name of a camera to its picture ``[H, W, 3]``.
        config: the thresholds.
        masks: name of a camera to ``[H, W]``, False where its picture does not count.
    """

    def __init__(
        self,
        images: Mapping[str, NDArray[np.uint8]],
        config: MatchConfig = MatchConfig(),
        *,
        masks: Mapping[str, NDArray[np.bool_]] | None = None,
    ) -> None:
        self._images = images
        self._masks = masks or {}
        self._config = config
        self._features: dict[str, Features] = {}
        self._found: dict[Pair, NDArray[np.intp]] = {}

    def matches(self, pairs: Sequence[Pair]) -> dict[Pair, tuple[Floats, Floats]]:
        """Pixels ``[S, 2]`` in the first and in the second picture of each pair; none where too few agree.

        Raises:
            MissingExtraError: cv2 is not installed.
        """
        found = self.indices(pairs)
        return {
            (first, second): (
                self._features[first].pixels[rows[:, 0]],
                self._features[second].pixels[rows[:, 1]],
            )
            for (first, second), rows in found.items()
        }

    def indices(self, pairs: Sequence[Pair]) -> dict[Pair, NDArray[np.intp]]:
        """As :meth:`matches`, numbers ``[S, 2]`` of keypoints."""
        names = sorted({name for pair in pairs for name in pair} - set(self._features))
        missing = [pair for pair in pairs if pair not in self._found]
        with ThreadPoolExecutor(max(1, min(len(names) + 1, os.cpu_count() or 1))) as pool:
            self._features |= zip(names, pool.map(self._extract, names), strict=True)
            self._found |= zip(missing, pool.map(self._match, missing), strict=True)
        return {pair: self._found[pair] for pair in pairs}

    def keypoints(self, name: str) -> Floats:
        """Pixels ``[S, 2]`` of the keypoints of a picture that was matched."""
        return self._features[name].pixels

    def _extract(self, name: str) -> Features:
        mask = self._masks.get(name)
        return sift_features(self._images[name], count=self._config.features, mask=mask, longest_side=KEYPOINT_SIDE)

    def _match(self, pair: Pair) -> NDArray[np.intp]:
        config, empty = self._config, np.empty((0, 2), np.intp)
        first, second = (self._features[name] for name in pair)
        if min(len(first.pixels), len(second.pixels)) < config.min_inliers:
            return empty
        rows, columns = mutual_matches(first.descriptors, second.descriptors, ratio=config.ratio).T
        if len(rows) < config.min_inliers:
            return empty
        cv2 = opencv()
        pixels1, pixels2 = first.pixels[rows], second.pixels[columns]
        height, width = np.maximum(*(self._images[name].shape[:2] for name in pair))
        most = config.inlier_pixels * enlargement(width, height)
        _, mask = cv2.findFundamentalMat(pixels1, pixels2, cv2.FM_RANSAC, most, 0.999, 2000)
        agree = np.zeros(len(rows), bool) if mask is None else mask.ravel().astype(bool)
        if agree.sum() < config.min_inliers or agree.mean() < config.min_inlier_share:
            return empty
        return np.stack([rows[agree], columns[agree]], 1)


@dataclass(frozen=True)
class PairError:
    """How badly the poses explain the matches of a pair: a median in pixels, and the share of violating matches."""

    pixels: float
    share: float
    matches: int


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


def neighbor_pairs(cameras: Mapping[str, Camera], *, count: int = 2) -> list[Pair]:
    """Each camera with its ``count`` best neighbours; at most ``MAX_PAIRS``, spread over the rig."""
    pairs = unique_pairs(neighbor_views(cameras, count=count, distance=viewing_distance(cameras)))
    chosen = np.linspace(0, len(pairs) - 1, min(len(pairs), MAX_PAIRS)).round().astype(int)
    return [pairs[index] for index in chosen]


def neighbor_errors(cameras: Mapping[str, Camera], matcher: PairMatcher) -> dict[Pair, PairError | None]:
    """The error of each pair of neighbours; None where their pictures do not match.

    Raises:
        MissingExtraError: cv2 is not installed.
    """
    matches = matcher.matches(neighbor_pairs(cameras))
    return {
        pair: pair_error(cameras[pair[0]], cameras[pair[1]], *pixels) if len(pixels[0]) else None
        for pair, pixels in matches.items()
    }


def confirmed_share(cameras: Mapping[str, Camera], matcher: PairMatcher) -> float:
    """The share of the pairs of neighbours whose pictures match and agree with the poses, to compare readings."""
    errors = neighbor_errors(cameras, matcher).values()
    return sum(error is not None and error.share <= PAIR_SHARE for error in errors) / max(1, len(errors))

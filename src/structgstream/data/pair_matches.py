# SPDX-License-Identifier: Apache-2.0
"""Keypoint matches between pictures, found without the poses, so that they can judge the poses."""

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from structgstream.cameras import enlargement
from structgstream.data.arrays import Floats
from structgstream.data.descriptor_matches import mutual_matches
from structgstream.data.images import opencv
from structgstream.data.matching import Features, Pair, sift_features


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
        return sift_features(self._images[name], count=self._config.features, mask=self._masks.get(name))

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

# SPDX-License-Identifier: Apache-2.0
"""Epipolar geometry of pairs of cameras: from a calibration, or from what stands still in the pictures."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from structgstream.data.arrays import Floats
from structgstream.data.descriptor_matches import mutual_matches
from structgstream.data.images import opencv
from structgstream.data.lenses import LensCamera
from structgstream.data.matching import Features, sift_features
from structgstream.preparation.synchronization.epipolar import PairGeometry

SAME_PLACE = 1e-6  # distance of cameras at one place, as a share of theirs to the origin
FEATURES = 3000
LONGER_SIDE = 960  # of pictures in which static features are looked for, pixels
RATIO = 0.8
INLIER_SHARE = 1 / 640  # of the picture's longer side
LEAST_INLIERS = 16


class Geometry(Protocol):
    """Says how the views of two cameras are related."""

    def pair(self, first: str, second: str, /) -> PairGeometry | None:
        """None where it is not known."""
        ...


@dataclass(frozen=True)
class CalibratedGeometry:
    """Epipolar geometry of calibrated cameras; the cameras of a pair need different positions."""

    cameras: Mapping[str, LensCamera]

    def pair(self, first: str, second: str, /) -> PairGeometry | None:
        """None if a camera has no calibration, or both are at one place."""
        if first not in self.cameras or second not in self.cameras:
            return None
        one, other = self.cameras[first], self.cameras[second]
        relative = other.camera.viewmat.numpy() @ np.linalg.inv(one.camera.viewmat.numpy())
        x, y, z = relative[:3, 3]
        size = max(float(np.linalg.norm(own.camera.viewmat.numpy()[:3, 3])) for own in (one, other))
        if not np.linalg.norm(relative[:3, 3]) > SAME_PLACE * size:
            return None
        essential = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) @ relative[:3, :3]
        return PairGeometry(essential, (one.to_normalized, other.to_normalized))


@dataclass(frozen=True)
class StaticGeometry:
    """Fundamental matrices from features of what stands still; lenses are taken as pinholes."""

    features: Mapping[str, Features]
    sizes: Mapping[str, tuple[int, int]]

    def pair(self, first: str, second: str, /) -> PairGeometry | None:
        """None if the views have too few features in common."""
        one, other = self.features[first], self.features[second]
        if min(len(one.pixels), len(other.pixels)) < LEAST_INLIERS:
            return None
        matches = mutual_matches(one.descriptors, other.descriptors, ratio=RATIO)
        if len(matches) < LEAST_INLIERS:
            return None
        F, inliers = opencv().findFundamentalMat(
            one.pixels[matches[:, 0]],
            other.pixels[matches[:, 1]],
            opencv().USAC_MAGSAC,
            max(self.sizes[first] + self.sizes[second]) * INLIER_SHARE,
            0.999,
            5000,
        )
        if F is None or F.shape != (3, 3) or int(inliers.sum()) < LEAST_INLIERS:
            return None
        return PairGeometry(F, (_same, _same), estimated=True)


def static_features(pictures: list[NDArray[np.uint8]]) -> Features:
    """Features of the median of pictures ``[H, W, 3]`` of one camera, in pixels of these."""
    cv2 = opencv()
    height, width = pictures[0].shape[:2]
    factor = min(LONGER_SIDE / max(width, height), 1.0)
    size = (max(round(width * factor), 1), max(round(height * factor), 1))
    reduced = [cv2.resize(picture, size, interpolation=cv2.INTER_AREA) for picture in pictures]
    still = np.median(np.stack(reduced), axis=0).astype(np.uint8)
    found = sift_features(still, count=FEATURES, contrast=0.005)
    return Features(found.pixels * [width / size[0], height / size[1]], found.descriptors)


def _same(pixels: Floats) -> Floats:
    return pixels

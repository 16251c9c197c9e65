# SPDX-License-Identifier: Apache-2.0
"""Keypoints and matches of made points, without pictures: what structure from motion works on."""

from collections.abc import Mapping
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from structgstream.data.lenses import LensCamera
from structgstream.data.matching import Pair
from structgstream.geometry import Floats
from structgstream.preparation.calibration.keypoints import Keypoints

Matches = dict[Pair, NDArray[np.uint32]]


def cloud(count: int = 150) -> Floats:
    """Points ``[P, 3]`` around the origin."""
    return np.random.default_rng(0).uniform(-0.6, 0.6, (count, 3))


def keypoints_of(rig: Mapping[str, LensCamera], points: Floats, *, noise: float = 0.0) -> dict[str, Keypoints]:
    """Keypoint ``i`` of each camera is where it sees point ``i``; all must be within reach of its lens."""
    generator = np.random.default_rng(1)
    found = {}
    for name, filmed in rig.items():
        pixels = filmed.pixels(points)
        assert np.isfinite(pixels).all()
        found[name] = Keypoints(
            pixels + noise * generator.normal(size=pixels.shape),
            np.zeros((len(points), 128), np.float32),
            np.ones((len(points), 1), bool),
        )
    return found


def matches_of(rig: Mapping[str, LensCamera], points: Floats) -> Matches:
    """For each pair the points in both pictures."""
    inside = {}
    for name, filmed in rig.items():
        pixels = filmed.pixels(points)
        inside[name] = ((pixels > 0) & (pixels < (filmed.camera.width, filmed.camera.height))).all(1)
    return {
        pair: np.repeat(np.flatnonzero(inside[pair[0]] & inside[pair[1]])[:, None], 2, 1).astype(np.uint32)
        for pair in combinations(rig, 2)
    }

# SPDX-License-Identifier: Apache-2.0
"""Checks the given poses against the pictures.

Inverted or flipped pose matrices are valid rigid motions, so only the pictures reveal them. Matches that were found
without the poses, and are inliers of some epipolar geometry, are tested against the epipolar geometry of the poses
(Hartley and Zisserman, Multiple View Geometry, chapter 11).
"""

import logging
import os
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from structgstream.cameras import Camera, CameraRig
from structgstream.data.matching import (
    Features,
    Floats,
    angles,
    epipolar_errors,
    fundamental_matrix,
    load_cv2,
    neighbor_views,
    rays,
    sift_features,
    triangulate,
    unique_pairs,
    viewing_distance,
)
from structgstream.errors import CalibrationError
from structgstream.frames import MultiViewFrame

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class PoseCheckConfig:
    """Thresholds of the pose check.

    Args:
        features: SIFT keypoints per picture.
        pairs: most pairs of neighbours tested.
        ratio: largest ratio of the best to the second-best descriptor distance.
        inlier_pixels: largest epipolar distance of inliers of a pair's own epipolar geometry.
        min_inliers: least number of inliers of a pair that is used.
        min_inlier_share: least share of inliers among the matches of a pair that is used.
        violation_share: distance to the epipolar line of the poses, as a share of the picture's width, above which a
            match violates them; a match triangulated behind a camera violates them too.
        min_parallax_degrees: smallest angle between the rays at which a point behind a camera counts.
        max_share: poses are rejected if a larger share of the good matches violates them.
        min_matches: least number of good matches for a verdict.
    """

    features: int = 1500
    pairs: int = 12
    ratio: float = 0.75
    inlier_pixels: float = 1.5
    min_inliers: int = 20
    min_inlier_share: float = 0.5
    violation_share: float = 0.01
    min_parallax_degrees: float = 0.3
    max_share: float = 0.6
    min_matches: int = 100


@dataclass(frozen=True)
class PoseCheck:
    """Result of the pose check.

    Args:
        median_epipolar_error_pixels: median distance to the epipolar line of the poses; nan without matches.
        share_violating: share of the good matches that violate the poses; nan without matches.
        matches: number of good matches.
        pairs: number of pairs of cameras they come from.
        conclusive: whether ``min_matches`` is reached.
    """

    median_epipolar_error_pixels: float
    share_violating: float
    matches: int
    pairs: int
    conclusive: bool


def check_poses(frame: MultiViewFrame, rig: CameraRig, *, config: PoseCheckConfig = PoseCheckConfig()) -> PoseCheck:
    """Test matches of neighbouring training cameras against the given poses; held-out pictures are never read.

    Raises:
        CalibrationError: most good matches violate the epipolar geometry of the poses.
        MissingExtraError: cv2 is not installed.
    """
    given = {name: rig[name] for name in frame.present(rig.training)}
    matcher = _Matcher(frame, config)
    check = _judge(given, matcher.matches(_pairs(given, config)), config)
    if check.conclusive and check.share_violating <= config.max_share:
        return check
    # Pairs chosen by wrong poses hardly match, so pairs chosen after undoing each common mistake are tested too.
    readings = {name: _reinterpret(given, change) for name, change in _MISTAKES.items()}
    pairs = dict.fromkeys(pair for cameras in (given, *readings.values()) for pair in _pairs(cameras, config))
    matches = matcher.matches(list(pairs))
    check = _judge(given, matches, config)
    if not check.conclusive:
        _log.warning("Too few good matches (%d) to check the camera poses against the pictures.", check.matches)
        return check
    if check.share_violating <= config.max_share:
        return check
    shares = {name: _judge(cameras, matches, config).share_violating for name, cameras in readings.items()}
    likely = min(shares, key=lambda name: shares[name])
    if shares[likely] < min(0.5, check.share_violating / 2):
        advice = f"{1 - shares[likely]:.0%} fit once {likely}."
    else:
        advice = (
            "Expected world-to-camera matrices with OpenCV axes (x right, y down, z forward), intrinsics in "
            "pixels of these pictures, and each camera's own pictures, in sync: check these."
        )
    raise CalibrationError(
        f"{check.share_violating:.0%} of {check.matches} good matches between neighbouring cameras violate "
        "the epipolar geometry of the given poses (median distance "
        f"{check.median_epipolar_error_pixels:.1f} pixels). {advice}"
    )


def _inverted(viewmat: Tensor) -> Tensor:
    return torch.linalg.inv(viewmat)


def _flipped(viewmat: Tensor) -> Tensor:
    return torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=viewmat.dtype)) @ viewmat


_MISTAKES: Mapping[str, Callable[[Tensor], Tensor]] = {
    "every pose is inverted: they look like camera-to-world matrices given as world-to-camera; invert them": _inverted,
    "the y and z axes of every camera are flipped: they look like OpenGL axes; expected OpenCV ones": _flipped,
    "every pose is inverted and its y and z axes flipped: they look like camera-to-world matrices with "
    "OpenGL axes; expected world-to-camera with OpenCV axes": lambda viewmat: _flipped(_inverted(viewmat)),
}


def _reinterpret(cameras: Mapping[str, Camera], change: Callable[[Tensor], Tensor]) -> dict[str, Camera]:
    return {name: replace(camera, viewmat=change(camera.viewmat)) for name, camera in cameras.items()}


def _pairs(cameras: Mapping[str, Camera], config: PoseCheckConfig) -> list[tuple[str, str]]:
    """Pairs of neighbours, spread over the rig."""
    pairs = unique_pairs(neighbor_views(cameras, count=2, distance=viewing_distance(cameras)))
    chosen = np.linspace(0, len(pairs) - 1, min(len(pairs), config.pairs)).round().astype(int)
    return [pairs[index] for index in chosen]


class _Matcher:
    """Good matches of pairs of pictures, independent of the poses; results per picture and pair are cached."""

    def __init__(self, frame: MultiViewFrame, config: PoseCheckConfig) -> None:
        self._frame = frame
        self._config = config
        self._features: dict[str, Features] = {}
        self._matches: dict[tuple[str, str], tuple[Floats, Floats]] = {}

    def matches(self, pairs: list[tuple[str, str]]) -> dict[tuple[str, str], tuple[Floats, Floats]]:
        """Pixels ``[S, 2]`` in the first and in the second picture of each pair."""
        names = sorted({name for pair in pairs for name in pair} - set(self._features))
        missing = [pair for pair in pairs if pair not in self._matches]
        with ThreadPoolExecutor(max(1, min(len(names) + 1, os.cpu_count() or 1))) as pool:
            self._features |= zip(names, pool.map(self._extract, names), strict=True)
            self._matches |= zip(missing, pool.map(self._match, missing), strict=True)
        return {pair: self._matches[pair] for pair in pairs}

    def _extract(self, name: str) -> Features:
        return sift_features(self._frame.images[name], count=self._config.features, mask=self._frame.masks.get(name))

    def _match(self, pair: tuple[str, str]) -> tuple[Floats, Floats]:
        config, empty = self._config, (np.empty((0, 2)), np.empty((0, 2)))
        first, second = (self._features[name] for name in pair)
        if min(len(first.pixels), len(second.pixels)) < config.min_inliers:
            return empty
        similarity = first.descriptors @ second.descriptors.T
        best = similarity.argmax(1)
        two = np.partition(similarity, -2, axis=1)[:, -2:]
        distances = np.sqrt(np.maximum(2 - 2 * two, 0))
        mutual = similarity.argmax(0)[best] == np.arange(len(best))
        kept = np.flatnonzero(mutual & (distances[:, 1] < config.ratio * distances[:, 0]))
        pixels1, pixels2 = first.pixels[kept], second.pixels[best[kept]]
        if len(kept) < config.min_inliers:
            return empty
        cv2 = load_cv2()
        _, mask = cv2.findFundamentalMat(pixels1, pixels2, cv2.FM_RANSAC, config.inlier_pixels, 0.999, 2000)
        agree = np.zeros(len(kept), bool) if mask is None else mask.ravel().astype(bool)
        if agree.sum() < config.min_inliers or agree.mean() < config.min_inlier_share:
            return empty
        return pixels1[agree], pixels2[agree]


def _judge(
    cameras: Mapping[str, Camera],
    matches: Mapping[tuple[str, str], tuple[Floats, Floats]],
    config: PoseCheckConfig,
) -> PoseCheck:
    errors: list[Floats] = []
    violating = 0
    for (first, second), (pixels1, pixels2) in matches.items():
        if len(pixels1) == 0:
            continue
        pair = cameras[first], cameras[second]
        error = epipolar_errors(fundamental_matrix(*pair), pixels1, pixels2)
        # Cameras that only differ in position keep their epipolar lines when inverted, but look backwards.
        _, depths = triangulate(*pair, pixels1, pixels2)
        parallax = np.degrees(angles(rays(pair[0], pixels1), rays(pair[1], pixels2)))
        behind = (depths < 0).any(1) & (parallax > config.min_parallax_degrees)
        violating += int(((error > config.violation_share * pair[0].width) | behind).sum())
        errors.append(error)
    total = sum(map(len, errors))
    if total == 0:
        return PoseCheck(float("nan"), float("nan"), 0, 0, False)
    return PoseCheck(
        float(np.median(np.concatenate(errors))),
        violating / total,
        total,
        len(errors),
        total >= config.min_matches,
    )

# SPDX-License-Identifier: Apache-2.0
"""Signals of motion: changes of a still camera's pictures, summed over corresponding epipolar lines of two views.

What changes on an epipolar line at an instant changes on the corresponding line of the other view at the same instant,
whatever the depth. So the changes of each view are summed over bundles of corresponding lines, which gives a signal for
each bundle that both views see at the same time, without matching a point. (Motion barcodes of lines: Ben-Artzi,
Kasten, Peleg and Werman, CVPR 2016; frontier points of silhouettes, which both views see on the same line: Hartley and
Zisserman, chapter 9.) The geometry comes from a calibration, or from what stands still in the pictures.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from structgstream.data.images import opencv, reduced_picture
from structgstream.data.lenses import LensCamera
from structgstream.data.matching import Features, mutual_matches, sift_features
from structgstream.geometry import Floats

CHANGES_SIDE = 160  # of reduced pictures, pixels: events are compared along lines, so positions need not be finer
SMOOTHING = 1.0  # standard deviation, reduced pixels
SAMPLED = 100  # frames whose noise is measured
NOISE_FACTOR, MIN_NOISE = 4.0, 0.5  # changes below this many times the median change are noise
MOST = 30.0  # larger changes count as this one: a bright shirt is not more of an event than a dark one
UNITS = 4  # of stored changes in a grey level
STILL = 5e-4  # share of MOST of a mean change below which nothing moves


@dataclass(frozen=True)
class Changes:
    """Changes of a camera's pictures."""

    amounts: NDArray[np.uint8]
    """``[T - 1, h, w]`` uint8: change from a frame to the next one above noise, in quarters of a grey level."""
    times: Floats  # ``[T - 1]`` seconds by the camera's clock, halfway between both frames
    size: tuple[int, int]  # width and height of the camera's pictures, pixels

    @property
    def activity(self) -> Floats:
        """``[T - 1, 1]``: sum over the picture of the square roots of changes."""
        return np.sqrt(self.amounts, dtype=np.float32).mean((1, 2), dtype=np.float64)[:, None]

    @property
    def moving(self) -> bool:
        """Whether anything moves."""
        return len(self.amounts) > 1 and float(self.amounts.mean()) > STILL * MOST * UNITS


def picture_changes(pictures: Iterable[NDArray[np.uint8]], stamps: Floats) -> Changes:
    """Changes of pictures ``[H, W, 3]`` that follow each other at ``stamps`` ``[T]``; only reduced ones stay."""
    reduced: list[NDArray[np.uint8]] = []
    size = (0, 0)
    for picture in pictures:
        size = (picture.shape[1], picture.shape[0])
        reduced.append(reduced_grey(picture))
    return reduced_changes(reduced, stamps[: len(reduced)], size)


def reduced_grey(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A picture ``[H, W, 3]`` as grey ``[h, w]`` whose longer side is at most :data:`CHANGES_SIDE`."""
    cv2 = opencv()
    # Reduced first: grey of a large picture would take longer than all else.
    return cv2.cvtColor(reduced_picture(picture, CHANGES_SIDE), cv2.COLOR_RGB2GRAY)


def reduced_changes(reduced: Sequence[NDArray[np.uint8]], stamps: Floats, size: tuple[int, int]) -> Changes:
    """Changes of reduced pictures ``[h, w]`` at ``stamps`` ``[T]`` of a camera of this width and height."""
    if len(reduced) < 2:
        return Changes(np.zeros((0, 1, 1), np.uint8), np.zeros(0), size)
    cv2 = opencv()
    noise = _noise(reduced)
    amounts = np.empty((len(reduced) - 1, *reduced[0].shape), np.uint8)
    before = cv2.GaussianBlur(reduced[0].astype(np.float32), (0, 0), SMOOTHING)
    for index, grey in enumerate(reduced[1:]):
        smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), SMOOTHING)
        above = np.clip(np.abs(smooth - before) - noise, 0, MOST)
        amounts[index] = np.rint(above * UNITS)
        before = smooth
    return Changes(amounts, (stamps[1:] + stamps[:-1]) / 2, size)


def _noise(reduced: Sequence[NDArray[np.uint8]]) -> float:
    """The change that counts as noise: a multiple of the median one, of some of the frames."""
    cv2 = opencv()
    firsts = np.unique(np.linspace(0, len(reduced) - 2, min(len(reduced) - 1, SAMPLED)).astype(int))
    steps = []
    for first in firsts.tolist():
        pair = [cv2.GaussianBlur(grey.astype(np.float32), (0, 0), SMOOTHING) for grey in reduced[first : first + 2]]
        steps.append(np.abs(pair[1] - pair[0]))
    return NOISE_FACTOR * max(float(np.median(np.stack(steps))), MIN_NOISE)


Straighten = Callable[[Floats], Floats]
"""From pixels ``[S, 2]`` as filmed to points that obey the fundamental matrix; NaN where the lens has no inverse."""

BUNDLES = 64
MIN_SHARE = 0.25  # of the pixels of the view that sees less of the common lines
SAME_PLACE = 1e-6  # distance of cameras at one place, as a share of theirs to the origin
FEATURES = 3000
FEATURES_SIDE = 960  # of pictures in which static features are looked for, pixels
RATIO = 0.8
INLIER_SHARE = 1 / 640  # of the picture's longer side
MIN_INLIERS = 16


@dataclass(frozen=True)
class PairGeometry:
    """Epipolar geometry of two views."""

    F: Floats  # ``[3, 3]`` with ``x2^T F x1 = 0`` for homogeneous points
    straighten: tuple[Straighten, Straighten]  # for each view, from filmed pixels to those points
    estimated: bool = False  # whether it is an estimate from pictures that may be wrong


def line_signals(first: Changes, second: Changes, geometry: PairGeometry) -> tuple[Floats, Floats] | None:
    """Signals ``[T1, B]`` and ``[T2, B]`` of the bundles that both views see; None if these are too few.

    Square roots are taken, so that a signal shows where something moves rather than how much.
    """
    angles = _angles(first, second, geometry)
    cut = _gap(np.concatenate(angles))
    one, other = ((angle - cut) % np.pi for angle in angles)
    ranges = [np.nanquantile(each, (0.005, 0.995)) for each in (one, other)]
    low, high = max(low for low, _ in ranges), min(high for _, high in ranges)
    if not high > low:
        return None
    if min(((each >= low) & (each <= high)).mean() for each in (one, other)) < MIN_SHARE:
        return None
    # Bundles of equally many pixels: lines fan out, and a bundle of few pixels is noise.
    both = np.concatenate([each[(each >= low) & (each <= high)] for each in (one, other)])
    edges = np.quantile(both, np.linspace(0, 1, BUNDLES + 1))
    return _summed(first, one, edges), _summed(second, other, edges)


def _angles(first: Changes, second: Changes, geometry: PairGeometry) -> tuple[Floats, Floats]:
    """For each pixel of both reduced views its epipolar line in the second view, as an angle modulo pi in the pencil of
    these lines."""
    F = geometry.F / np.linalg.norm(geometry.F)
    epipole = np.linalg.svd(F)[0][:, 2]  # of the second view: e2^T F = 0
    of_first = _points(first, geometry.straighten[0]) @ F.T
    of_second = np.cross(epipole, _points(second, geometry.straighten[1]))
    # Lines of a pencil have two coordinates; those in which the view's lines are spread evenly keep angles well scaled.
    seen = of_second[np.isfinite(of_second).all(1)]
    values, vectors = np.linalg.eigh(seen.T @ seen / len(seen))
    coordinates = vectors[:, 1:] / np.sqrt(np.maximum(values[1:], 1e-12 * values[2]))
    one, other = of_first @ coordinates, of_second @ coordinates
    return np.arctan2(one[:, 0], one[:, 1]) % np.pi, np.arctan2(other[:, 0], other[:, 1]) % np.pi


def _points(view: Changes, straighten: Straighten) -> Floats:
    """Homogeneous points of the reduced pixels' centres."""
    _, height, width = view.amounts.shape
    x, y = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
    points = straighten(np.stack([x.ravel() * view.size[0], y.ravel() * view.size[1]], axis=1))
    return np.concatenate([points, np.ones((len(points), 1))], axis=1)


def _gap(angles: Floats) -> float:
    """The angle in the middle of the widest range modulo pi that no line has."""
    ordered = np.sort(angles[np.isfinite(angles)])
    gaps = np.diff(ordered, append=ordered[0] + np.pi)
    widest = int(gaps.argmax())
    return float(ordered[widest] + gaps[widest] / 2) % np.pi


def _summed(view: Changes, angles: Floats, edges: Floats) -> Floats:
    """Square roots of the mean change ``[T, B]`` in each bundle."""
    from scipy.sparse import csr_matrix

    bundle = np.searchsorted(edges, angles, side="right") - 1
    inside = np.isfinite(angles) & (bundle >= 0) & (bundle < BUNDLES)
    pixels = np.flatnonzero(inside)
    shape = (len(angles), BUNDLES)
    membership = csr_matrix((np.ones(len(pixels), np.float32), (pixels, bundle[inside])), shape=shape)
    counts = np.maximum(np.bincount(bundle[inside], minlength=BUNDLES), 1)
    flat = view.amounts.reshape(len(view.amounts), -1)
    sums = np.concatenate(
        [part.astype(np.float32) @ membership for part in np.array_split(flat, max(len(flat) // 200, 1))]
    )
    return np.sqrt(sums / counts, dtype=np.float64)


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
        if min(len(one.pixels), len(other.pixels)) < MIN_INLIERS:
            return None
        matches = mutual_matches(one.descriptors, other.descriptors, ratio=RATIO)
        if len(matches) < MIN_INLIERS:
            return None
        F, inliers = opencv().findFundamentalMat(
            one.pixels[matches[:, 0]],
            other.pixels[matches[:, 1]],
            opencv().USAC_MAGSAC,
            max(self.sizes[first] + self.sizes[second]) * INLIER_SHARE,
            0.999,
            5000,
        )
        if F is None or F.shape != (3, 3) or int(inliers.sum()) < MIN_INLIERS:
            return None
        return PairGeometry(F, (_same, _same), estimated=True)


def static_features(pictures: list[NDArray[np.uint8]]) -> Features:
    """Features of the median of pictures ``[H, W, 3]`` of one camera, in pixels of these."""
    height, width = pictures[0].shape[:2]
    still = np.median([reduced_picture(picture, FEATURES_SIDE) for picture in pictures], axis=0).astype(np.uint8)
    found = sift_features(still, count=FEATURES, contrast=0.005)
    return Features(found.pixels * [width / still.shape[1], height / still.shape[0]], found.descriptors)


def _same(pixels: Floats) -> Floats:
    return pixels

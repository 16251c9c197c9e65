# SPDX-License-Identifier: Apache-2.0
"""Neighbouring views and keypoint matches between them: guided by known poses, or without poses, to test them.

With poses a keypoint is compared with those near its epipolar line only (Hartley and Zisserman, Multiple View Geometry,
chapters 9 and 12). Without, descriptors match if they are each other's nearest and pass the ratio test (Lowe, IJCV
2004, section 7.1). Pixels follow the package's convention, the top-left pixel's centre at (0.5, 0.5)."""

import math
import os
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from structgstream.cameras import Camera, enlargement
from structgstream.data.images import opencv, reduced_mask, reduced_picture
from structgstream.geometry import Floats, Indices, cross_matrices

Pair = tuple[str, str]
"""Names of two cameras."""

_DEPTH_SHARES = np.array([0.5, 0.7, 1.0, 1.4, 2.0])
_GRID = (np.arange(6) + 0.5) / 6
_BEST_ANGLES_DEGREES = (7.0, 20.0)


@dataclass(frozen=True)
class Features:
    """Keypoints of a picture: ``pixels [S, 2]`` float64, unit ``descriptors [S, 128]`` float32 (RootSIFT)."""

    pixels: Floats
    descriptors: NDArray[np.float32]


def sift_features(
    image: NDArray[np.uint8],
    *,
    count: int,
    contrast: float = 0.01,
    mask: NDArray[np.bool_] | None = None,
    longest_side: int | None = None,
) -> Features:
    """The strongest ``count`` SIFT keypoints of an RGB picture ``[H, W, 3]``, of its pixels ``mask`` ``[H, W]``.

    Larger pictures are reduced to ``longest_side`` pixels; keypoints are in pixels of ``image`` all the same.
    Descriptors are square-rooted after L1 normalisation, so that their dot product is the Hellinger kernel
    (Arandjelovic and Zisserman, CVPR 2012).
    """
    cv2 = opencv()
    height, width = image.shape[:2]
    if longest_side is not None:
        image = reduced_picture(image, longest_side)
        mask = None if mask is None else reduced_mask(mask, image.shape[1::-1])
    # Without the precise upscale every keypoint would be off by a quarter of a pixel.
    sift = cv2.SIFT.create(count, contrastThreshold=contrast, edgeThreshold=12.0, enable_precise_upscale=True)
    within = np.empty(0) if mask is None else mask.astype(np.uint8)
    keypoints, descriptors = sift.detectAndCompute(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), within)
    if descriptors is None or len(keypoints) == 0:
        return Features(np.empty((0, 2)), np.empty((0, 128), np.float32))
    pixels = np.array([keypoint.pt for keypoint in keypoints], np.float64) + 0.5
    pixels *= width / image.shape[1], height / image.shape[0]
    rooted = np.sqrt(descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-9), dtype=np.float32)
    return Features(pixels, rooted)


def project(camera: Camera, points: Floats) -> tuple[Floats, Floats]:
    """Pixels ``[..., 2]`` and depths ``[...]`` of points ``[..., 3]``; pixels behind the camera are invalid."""
    viewmat, K = camera.viewmat.numpy(), camera.K.numpy()
    local = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    depths = local[..., 2]
    homogeneous = local @ K.T
    return homogeneous[..., :2] / np.where(np.abs(depths) < 1e-12, 1e-12, depths)[..., None], depths


def back_project(camera: Camera, pixels: Floats, depths: Floats) -> Floats:
    """World points ``[P, 3]`` at ``depths [P]`` (along z) behind ``pixels [P, 2]``."""
    return camera.center.numpy() + rays(camera, pixels) * depths[:, None]


def inside(camera: Camera, pixels: Floats, depths: Floats, *, near: float) -> NDArray[np.bool_]:
    """Which projections ``[...]`` fall into the picture, beyond ``near``."""
    x, y = pixels[..., 0], pixels[..., 1]
    return (depths > near) & (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)


def viewing_distance(cameras: Mapping[str, Camera]) -> float:
    """Typical distance from a camera to the scene, estimated from the poses.

    It is the distance to the point nearest to all optical axes, if that lies in front of most cameras; for nearly
    parallel axes (a flat forward-facing array) five times the rig's radius.
    """
    centers = np.stack([camera.center.numpy() for camera in cameras.values()])
    axes = np.stack([camera.viewmat.numpy()[2, :3] for camera in cameras.values()])
    projectors = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    focus = np.linalg.lstsq(projectors.sum(0), (projectors @ centers[:, :, None]).sum(0)[:, 0], rcond=1e-6)[0]
    depths = ((focus - centers) * axes).sum(1)
    radius = float(np.linalg.norm(centers - centers.mean(0), axis=1).max())
    distance = float(np.median(depths))
    meets = (depths > 0).mean() > 0.7 and distance < 30 * radius
    return max(distance if meets else 5 * radius, 1e-9)


def level_normal(cameras: Mapping[str, Camera]) -> Floats:
    """The unit normal ``[3]`` of horizontal planes, pointing up: perpendicular to the cameras' x axes.

    Assumes cameras without roll. If all x axes are parallel, the perpendicular direction nearest to the pictures' mean
    up direction is taken.
    """
    axes = np.stack([camera.viewmat.numpy()[0, :3] for camera in cameras.values()])
    upwards = -np.mean([camera.viewmat.numpy()[1, :3] for camera in cameras.values()], axis=0)
    values, vectors = np.linalg.eigh(axes.T @ axes / len(axes))
    flat = vectors[:, values < max(1.5 * values[0], 1e-3)]
    normal = flat @ (flat.T @ upwards)
    return normal / max(float(np.linalg.norm(normal)), 1e-12)


def neighbor_views(cameras: Mapping[str, Camera], *, count: int, distance: float) -> dict[str, tuple[str, ...]]:
    """For each camera the ``count`` others that see most of its volume under a useful parallax, best first.

    The volume is sampled around ``distance`` (see :func:`viewing_distance`). Too small a parallax gives no depth, too
    large a one changes appearance.
    """
    low, high = _BEST_ANGLES_DEGREES
    chosen: dict[str, tuple[str, ...]] = {}
    for name, camera in cameras.items():
        axes = np.meshgrid(_GRID * camera.width, _GRID * camera.height, _DEPTH_SHARES * distance, indexing="ij")
        u, v, depths = map(np.ravel, axes)
        points = back_project(camera, np.stack([u, v], 1), depths)
        scores: dict[str, float] = {}
        for other_name, other in cameras.items():
            if other_name == name:
                continue
            seen = inside(other, *project(other, points), near=0.05 * distance)
            if not seen.any():
                continue
            rays_here, rays_there = (points[seen] - view.center.numpy() for view in (camera, other))
            angle = float(np.degrees(np.median(angles(rays_here, rays_there))))
            useful = min(angle / low, 1.0) * min(high / max(angle, 1e-9), 1.0) ** 2
            scores[other_name] = float(seen.mean()) * useful
        ranked = sorted((other for other in scores if scores[other] > 0.02), key=lambda other: -scores[other])
        chosen[name] = tuple(ranked[:count])
    return chosen


def unique_pairs(neighbours: Mapping[str, tuple[str, ...]]) -> list[Pair]:
    """Each pair of neighbours once, in the mapping's order."""
    pairs: dict[frozenset[str], Pair] = {}
    for name, others in neighbours.items():
        for other in others:
            pairs.setdefault(frozenset((name, other)), (name, other))
    return list(pairs.values())


def connected_groups(names: Iterable[str], pairs: Iterable[Pair]) -> list[tuple[str, ...]]:
    """Groups of cameras that pairs connect, the largest first; each in the order of ``names``."""
    group = {name: index for index, name in enumerate(names)}
    for one, two in pairs:
        old, new = max(group[one], group[two]), min(group[one], group[two])
        group = {name: new if index == old else index for name, index in group.items()}
    members: dict[int, list[str]] = {}
    for name, index in group.items():
        members.setdefault(index, []).append(name)
    return sorted(map(tuple, members.values()), key=len, reverse=True)


def fundamental_matrix(first: Camera, second: Camera) -> Floats:
    """``F [3, 3]`` with ``x2^T F x1 = 0`` for homogeneous pixels of one point in both pictures."""
    relative = second.viewmat.numpy() @ np.linalg.inv(first.viewmat.numpy())
    cross = cross_matrices(relative[:3, 3])
    F = np.linalg.inv(second.K.numpy()).T @ cross @ relative[:3, :3] @ np.linalg.inv(first.K.numpy())
    return F / max(float(np.linalg.norm(F)), 1e-300)


def epipolar_errors(F: Floats, first: Floats, second: Floats) -> Floats:
    """Distance in pixels ``[S]`` of matches to their epipolar lines, the larger one of the two pictures."""
    first, second = _homogeneous(first), _homogeneous(second)
    lines2, lines1 = first @ F.T, second @ F
    residual = np.abs((second * lines2).sum(1))
    slopes = np.minimum(np.linalg.norm(lines1[:, :2], axis=1), np.linalg.norm(lines2[:, :2], axis=1))
    return residual / np.maximum(slopes, 1e-300)


def triangulate(first: Camera, second: Camera, pixels1: Floats, pixels2: Floats) -> tuple[Floats, Floats]:
    """Points ``[S, 3]`` halfway between two rays where they pass closest, and depths ``[S, 2]`` along z."""
    rays1, rays2 = rays(first, pixels1), rays(second, pixels2)
    base = second.center.numpy() - first.center.numpy()
    a, b, c = (rays1 * rays1).sum(1), (rays1 * rays2).sum(1), (rays2 * rays2).sum(1)
    d, e = rays1 @ base, rays2 @ base
    # Parallel rays meet at infinity; the floor on the determinant avoids a division by zero.
    determinant = np.maximum(a * c - b * b, 1e-12 * a * c)
    along1, along2 = (c * d - b * e) / determinant, (b * d - a * e) / determinant
    points1 = first.center.numpy() + rays1 * along1[:, None]
    points2 = second.center.numpy() + rays2 * along2[:, None]
    return (points1 + points2) / 2, np.stack([along1, along2], 1)


def guided_matches(
    first: Features,
    second: Features,
    cameras: tuple[Camera, Camera],
    *,
    line_pixels: float,
    depth_range: tuple[float, float],
    ratio: float,
) -> Indices:
    """Mutually best matches ``[S, 2]`` (indices into the two sets) among keypoints near the epipolar line.

    A match survives if no other candidate, further than :data:`DISTINCT_PIXELS` from it, comes within ``ratio`` of its
    descriptor distance: along a line repeating texture is the main danger. Candidates outside ``depth_range`` of either
    camera are not considered.
    """
    F = fundamental_matrix(*cameras)
    lines = _homogeneous(first.pixels) @ F.T
    lines /= np.maximum(np.linalg.norm(lines[:, :2], axis=1, keepdims=True), 1e-300)
    distances = lines.astype(np.float32) @ _homogeneous(second.pixels).astype(np.float32).T
    row, column = np.nonzero(np.abs(distances) < line_pixels)
    _, depths = triangulate(*cameras, first.pixels[row], second.pixels[column])
    in_range = ((depths > depth_range[0]) & (depths < depth_range[1])).all(1)
    row, column = row[in_range], column[in_range]
    return mutually_best(first, second, row, column, ratio=ratio)


def mutually_best(
    first: Features, second: Features, row: Indices, column: Indices, *, ratio: float, distance: float = np.inf
) -> Indices:
    """Matches ``[S, 2]`` among candidates that are each other's best and pass the ratio test both ways.

    Args:
        row: ``[C]``, of each candidate the index into ``first``; ``column`` that into ``second``.
        ratio: largest ratio of the best descriptor distance to that of a rival, see :func:`distinct_best`.
        distance: descriptor distance below which a match must be.
    """
    similarity = np.einsum("sd,sd->s", first.descriptors[row], second.descriptors[column])
    cost = np.sqrt(np.maximum(2 - 2 * similarity, 1e-12))
    forward = distinct_best(row, column, cost, second.pixels, ratio=ratio)
    backward = distinct_best(column, row, cost, first.pixels, ratio=ratio)
    mutual = np.intersect1d(forward, backward)
    mutual = mutual[cost[mutual] < distance]
    return np.stack([row[mutual], column[mutual]], 1)


DISTINCT_PIXELS = 4.0  # what lies nearer to the best candidate is no rival of it


def distinct_best(
    query: Indices, candidate: Indices, cost: NDArray[np.float32], pixels: Floats, *, ratio: float
) -> Indices:
    """Positions, in a list of candidates, of each query's best one if it passes the ratio test.

    Args:
        query: ``[C]``, whose candidate each is.
        candidate: ``[C]``, index into ``pixels`` ``[S, 2]`` of the candidates' keypoints.
        cost: ``[C]``, descriptor distance.
    """
    order = np.lexsort((cost, query))
    is_first = np.diff(query[order], prepend=-1) != 0
    best, group = order[is_first], np.cumsum(is_first) - 1
    distances = np.linalg.norm(pixels[candidate[order]] - pixels[candidate[best]][group], axis=1)
    rival = distances > DISTINCT_PIXELS
    rival_cost = np.full(len(best), np.inf)
    np.minimum.at(rival_cost, group[rival], cost[order][rival])
    return best[cost[best] < ratio * rival_cost]


def rays(camera: Camera, pixels: Floats) -> Floats:
    """World directions ``[P, 3]`` through pixels, of length one along the camera's z."""
    return _homogeneous(pixels) @ np.linalg.inv(camera.K.numpy()).T @ camera.viewmat.numpy()[:3, :3]


def rays_of_pixels(camera: Camera) -> Floats:
    """Directions ``[H, W, 3]`` through the pixel centres in the camera's own axes, of length one along z."""
    column, row = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    return np.stack([column, row, np.ones_like(column)], -1) @ np.linalg.inv(camera.K.numpy()).T


def _homogeneous(pixels: Floats) -> Floats:
    return np.concatenate([pixels, np.ones((len(pixels), 1))], 1)


def angles(first: Floats, second: Floats) -> Floats:
    """Angles ``[P]`` in radians between directions ``[P, 3]``."""
    cosine = (first * second).sum(1) / (np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1))
    return np.arccos(np.clip(cosine, -1, 1))


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
) -> Indices:
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
) -> tuple[Indices, NDArray[np.float32], NDArray[np.bool_]]:
    """For each row the column of the largest value, this, and whether it stands out. Changes ``similarity``."""
    lines = np.arange(len(similarity))
    nearest = similarity.argmax(1)
    top = similarity[lines, nearest]
    similarity[lines, nearest] = OPPOSITE
    next_best = similarity.max(1)
    first_distance, second_distance = (np.sqrt(np.maximum(2 - 2 * value, 0)) for value in (top, next_best))
    return nearest, top, (first_distance < ratio * second_distance) & (first_distance < distance)


FEATURES, RATIO = 1500, 0.75  # SIFT keypoints per picture; largest ratio of the best to the second-best distance
INLIER_PIXELS = 1.5
"""Largest epipolar distance of inliers of a pair's own epipolar geometry, in pixels of a picture of the reference size
(``cameras.enlargement``)."""
MIN_INLIERS, MIN_INLIER_SHARE = 20, 0.5  # of the matches of a pair that is used


class PairMatcher:
    """Matches of pairs of pictures ``[H, W, 3]`` by camera that are inliers of some epipolar geometry (Hartley and
    Zisserman, Multiple View Geometry, chapter 11); pixels where ``masks`` ``[H, W]`` are False have no keypoints.
    Results per picture and pair are cached."""

    def __init__(
        self, images: Mapping[str, NDArray[np.uint8]], *, masks: Mapping[str, NDArray[np.bool_]] | None = None
    ) -> None:
        self._images = images
        self._masks = masks or {}
        self._features: dict[str, Features] = {}
        self._found: dict[Pair, Indices] = {}

    def matches(self, pairs: Sequence[Pair]) -> dict[Pair, tuple[Floats, Floats]]:
        """Pixels ``[S, 2]`` in the first and in the second picture of each pair; none where too few agree."""
        return {
            (first, second): (self.keypoints(first)[rows[:, 0]], self.keypoints(second)[rows[:, 1]])
            for (first, second), rows in self.indices(pairs).items()
        }

    def indices(self, pairs: Sequence[Pair]) -> dict[Pair, Indices]:
        """As :meth:`matches`, numbers ``[S, 2]`` of keypoints."""
        names = sorted({name for pair in pairs for name in pair} - set(self._features))
        missing = [pair for pair in pairs if pair not in self._found]
        with ThreadPoolExecutor(min(len(names) + 1, os.cpu_count() or 1)) as pool:
            self._features |= zip(names, pool.map(self._extract, names), strict=True)
            self._found |= zip(missing, pool.map(self._match, missing), strict=True)
        return {pair: self._found[pair] for pair in pairs}

    def keypoints(self, name: str) -> Floats:
        """Pixels ``[S, 2]`` of the keypoints of a matched picture."""
        return self._features[name].pixels

    def _extract(self, name: str) -> Features:
        mask = self._masks.get(name)
        return sift_features(self._images[name], count=FEATURES, mask=mask, longest_side=KEYPOINT_SIDE)

    def _match(self, pair: Pair) -> Indices:
        empty = np.empty((0, 2), np.intp)
        first, second = (self._features[name] for name in pair)
        rows, columns = mutual_matches(first.descriptors, second.descriptors, ratio=RATIO).T
        if len(rows) < MIN_INLIERS:
            return empty
        cv2 = opencv()
        pixels1, pixels2 = first.pixels[rows], second.pixels[columns]
        height, width = np.maximum(*(self._images[name].shape[:2] for name in pair))
        most = INLIER_PIXELS * enlargement(width, height)
        _, mask = cv2.findFundamentalMat(pixels1, pixels2, cv2.FM_RANSAC, most, 0.999, 2000)
        agree = np.zeros(len(rows), bool) if mask is None else mask.ravel().astype(bool)
        if agree.sum() < MIN_INLIERS or agree.mean() < MIN_INLIER_SHARE:
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
    """The error of each pair of neighbours; None where their pictures do not match."""
    matches = matcher.matches(neighbor_pairs(cameras))
    return {
        pair: pair_error(cameras[pair[0]], cameras[pair[1]], *pixels) if len(pixels[0]) else None
        for pair, pixels in matches.items()
    }


def confirmed_share(cameras: Mapping[str, Camera], matcher: PairMatcher) -> float:
    """The share of the pairs of neighbours whose pictures match and agree with the poses, to compare readings."""
    errors = neighbor_errors(cameras, matcher).values()
    return sum(error is not None and error.share <= PAIR_SHARE for error in errors) / max(1, len(errors))

# SPDX-License-Identifier: Apache-2.0
"""A small plane sweep: depth maps of the training cameras from zero-mean normalised cross-correlation.

Each neighbour's picture is warped by the homographies of planes parallel to the reference picture, spaced evenly in
inverse depth (Collins, CVPR 1996); the best half of the neighbours scores a plane, which tolerates occlusion (Kang,
Szeliski and Chai, CVPR 2001). Correlation, because cameras of one rig may differ in exposure by half.
"""

import math
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from structgstream.cameras import Camera
from structgstream.data.matching import Floats, back_project, inside, project
from structgstream.errors import MissingExtraError

FloatImage = NDArray[np.float32]

# Larger than any sum of grey values in a window, so that a window touching a place outside the picture shows.
_OUTSIDE = -1e3


@dataclass(frozen=True)
class SweepConfig:
    """How the plane sweep looks for depth, and what it believes.

    Args:
        width: width the pictures are reduced to, pixels.
        planes: fewest and most planes; between them, one per pixel of disparity.
        window: side of the correlation window, reduced pixels.
        noise: grey-level noise (of 1) added to the variances: flat windows then correlate with nothing.
        min_score: least correlation.
        min_margin: least lead of the best plane over any other that is not its neighbour.
        agreement: largest disagreement with another view's depth, in planes or as a share of depth (the larger one).
        views: further views that must agree.
    """

    width: int = 240
    planes: tuple[int, int] = (48, 128)
    window: int = 5
    noise: float = 0.008
    min_score: float = 0.6
    min_margin: float = 0.04
    agreement: tuple[float, float] = (1.0, 0.01)
    views: int = 2


@dataclass(frozen=True)
class DepthMap:
    """Depth seen by one reduced camera.

    Args:
        camera: the camera at the size of the map.
        inverse_depth: ``[H, W]`` float64, 1 / z.
        step: distance of two planes in inverse depth.
        believed: ``[H, W]``, which pixels scored high and without a rival.
    """

    camera: Camera
    inverse_depth: Floats
    step: float
    believed: NDArray[np.bool_]


@dataclass(frozen=True)
class SweepView:
    """A picture ready for the sweep: reduced camera, grey values ``[H, W]`` in [0, 1] and colours ``[H, W, 3]``."""

    camera: Camera
    grey: FloatImage
    colors: NDArray[np.uint8]


def sweep_view(camera: Camera, image: NDArray[np.uint8], *, width: int) -> SweepView:
    """The picture averaged down to at most ``width`` pixels, with its camera."""
    cv2 = _cv2()
    width = min(width, camera.width)
    height = max(1, round(camera.height * width / camera.width))
    colors = np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    grey = cv2.cvtColor(colors.astype(np.float32) / 255, cv2.COLOR_RGB2GRAY)
    return SweepView(camera.resized(width, height), np.asarray(grey, np.float32), colors)


def sweep_depth(
    reference: SweepView, neighbours: Sequence[SweepView], *, depth_range: tuple[float, float], config: SweepConfig
) -> DepthMap:
    """The best plane of every pixel of ``reference``, refined by a parabola through the scores around it."""
    near, far = depth_range
    planes = _plane_count(reference.camera, [view.camera for view in neighbours], depth_range, config.planes)
    inverse = np.linspace(1 / far, 1 / near, planes)
    scores = np.stack([_plane_score(reference, neighbours, 1 / value, config) for value in inverse])
    best = scores.argmax(0)
    index = np.arange(planes)[:, None, None]
    peak = np.take_along_axis(scores, best[None], 0)[0]
    rival = np.where(np.abs(index - best) > 2, scores, -1.0).max(0)
    before = np.take_along_axis(scores, np.maximum(best - 1, 0)[None], 0)[0]
    after = np.take_along_axis(scores, np.minimum(best + 1, planes - 1)[None], 0)[0]
    interior = (best > 0) & (best < planes - 1) & (before > -1) & (after > -1)
    bend = np.maximum(2 * peak - before - after, 1e-6)
    shift = np.where(interior, np.clip((after - before) / (2 * bend), -0.5, 0.5), 0.0)
    step = (inverse[-1] - inverse[0]) / (planes - 1)
    believed = interior & (peak > config.min_score) & (peak - rival > config.min_margin)
    return DepthMap(reference.camera, inverse[0] + (best + shift) * step, step, believed)


def consistent_points(
    maps: Mapping[str, DepthMap], views: Mapping[str, SweepView], *, config: SweepConfig
) -> tuple[Floats, NDArray[np.uint8]]:
    """Points ``[P, 3]`` and colours ``[P, 3]`` of the believed pixels on whose depth enough further views agree.

    A point is the mean of its own estimate and of those of the views that agree.
    """
    positions: list[Floats] = []
    colors: list[NDArray[np.uint8]] = []
    for name, depth_map in maps.items():
        row, column = np.nonzero(depth_map.believed)
        pixels = np.stack([column, row], 1) + 0.5
        points = back_project(depth_map.camera, pixels, 1 / depth_map.inverse_depth[row, column])
        total, agreeing = points.copy(), np.zeros(len(points), np.intp)
        for other_name, other in maps.items():
            if other_name == name:
                continue
            seen, estimate = _agreement(points, depth_map, pixels, other, config)
            agreeing[seen] += 1
            total[seen] += estimate
        kept = agreeing >= config.views
        positions.append(total[kept] / (agreeing[kept, None] + 1))
        colors.append(views[name].colors[row[kept], column[kept]])
    return np.concatenate(positions), np.concatenate(colors)


def sweep_points(
    cameras: Mapping[str, Camera],
    images: Mapping[str, NDArray[np.uint8]],
    *,
    neighbours: Mapping[str, tuple[str, ...]],
    depth_ranges: Mapping[str, tuple[float, float]],
    workers: int,
    config: SweepConfig = SweepConfig(),
) -> tuple[Floats, NDArray[np.uint8]]:
    """Consistent points and their colours from depth maps of all ``cameras``; ``images`` as ``[H, W, 3]`` uint8.

    Raises:
        MissingExtraError: cv2 is not installed.
    """
    views = {name: sweep_view(camera, images[name], width=config.width) for name, camera in cameras.items()}

    def depth_map(name: str) -> DepthMap:
        others = [views[other] for other in neighbours[name]]
        return sweep_depth(views[name], others, depth_range=depth_ranges[name], config=config)

    names = [name for name in cameras if neighbours[name]]
    with ThreadPoolExecutor(workers) as pool:
        maps = dict(zip(names, pool.map(depth_map, names), strict=True))
    if not maps:
        return np.empty((0, 3)), np.empty((0, 3), np.uint8)
    return consistent_points(maps, views, config=config)


def _agreement(
    points: Floats, own: DepthMap, pixels: Floats, other: DepthMap, config: SweepConfig
) -> tuple[NDArray[np.intp], Floats]:
    """Which of ``points`` the other map confirms, and its own estimates of them."""
    projected, depths = project(other.camera, points)
    seen = np.flatnonzero(inside(other.camera, projected, depths, near=0.0))
    column, row = projected[seen].astype(np.intp).T
    inverse = other.inverse_depth[row, column]
    planes, share = config.agreement
    tolerance = np.maximum(planes * other.step, share * inverse)
    close = other.believed[row, column] & (np.abs(inverse - 1 / depths[seen]) < tolerance)
    seen, inverse = seen[close], inverse[close]
    # The other view's depth along the ray through this very point, so that no pixel grid shows in the mean.
    estimate = back_project(other.camera, projected[seen], 1 / inverse)
    returned, _ = project(own.camera, estimate)
    near_pixel = np.linalg.norm(returned - pixels[seen], axis=1) < 1.5
    return seen[near_pixel], estimate[near_pixel]


def _plane_count(
    camera: Camera, others: Sequence[Camera], depth_range: tuple[float, float], limits: tuple[int, int]
) -> int:
    """Planes that a pixel in the middle of the picture needs to move by one pixel from one to the next."""
    middle = np.array([[camera.width / 2, camera.height / 2]])
    focal = float(camera.K[0, 0])
    inverse = 1 / depth_range[0] - 1 / depth_range[1]
    ray = back_project(camera, middle, np.ones(1))[0] - camera.center.numpy()
    ray /= np.linalg.norm(ray)
    bases = [other.center.numpy() - camera.center.numpy() for other in others]
    across = float(np.median([np.linalg.norm(base - (base @ ray) * ray) for base in bases]))
    return int(np.clip(math.ceil(focal * across * inverse), *limits))


def _plane_score(reference: SweepView, neighbours: Sequence[SweepView], depth: float, config: SweepConfig) -> FloatImage:
    """Mean correlation ``[H, W]`` of the better half of the neighbours on one plane; -1 where none sees it."""
    scores = np.stack([_correlation(reference, view, depth, config) for view in neighbours])
    half = max(1, (len(neighbours) + 1) // 2)
    return np.partition(scores, len(scores) - half, axis=0)[-half:].mean(0)


def _correlation(reference: SweepView, other: SweepView, depth: float, config: SweepConfig) -> FloatImage:
    """Correlation ``[H, W]`` of the reference with another picture seen through the plane; -1 outside it."""
    cv2 = _cv2()
    height, width = reference.grey.shape
    homography, facing = _plane_homography(reference.camera, other.camera, depth)
    if not facing.any():
        return np.full((height, width), -1, np.float32)
    warped = cv2.warpPerspective(
        other.grey,
        homography,
        (width, height),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=(_OUTSIDE,),
    )
    warped[~facing] = _OUTSIDE
    window = (config.window, config.window)

    def mean(image: FloatImage) -> FloatImage:
        return np.asarray(cv2.boxFilter(image, -1, window, borderType=cv2.BORDER_REFLECT), np.float32)

    grey, noise = reference.grey, config.noise**2
    mean_own, mean_other = mean(grey), mean(warped)
    outside = mean_other < 0
    warped[warped < 0] = 0
    covariance = mean(grey * warped) - mean_own * mean_other
    variances = (mean(grey * grey) - mean_own**2 + noise) * (mean(warped * warped) - mean_other**2 + noise)
    score = covariance / np.sqrt(np.maximum(variances, noise**2))
    score[outside] = -1
    return score


def _plane_homography(reference: Camera, other: Camera, depth: float) -> tuple[Floats, NDArray[np.bool_]]:
    """From the reference's pixel indices to the other's on the plane at ``depth``; which pixels it lies before."""
    relative = other.viewmat.numpy() @ np.linalg.inv(reference.viewmat.numpy())
    plane = relative[:3, :3].copy()
    plane[:, 2] += relative[:3, 3] / depth
    # cv2 puts the first pixel's centre at 0, the cameras at 0.5.
    centred = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])
    homography = np.linalg.inv(centred) @ other.K.numpy() @ plane @ np.linalg.inv(reference.K.numpy()) @ centred
    row, column = np.mgrid[: reference.height, : reference.width]
    return homography, homography[2, 0] * column + homography[2, 1] * row + homography[2, 2] > 1e-6


def _cv2():  # noqa: ANN202 - a module
    try:
        import cv2
    except ImportError:
        raise MissingExtraError("cv2", "capture") from None
    return cv2

# SPDX-License-Identifier: Apache-2.0
"""Initial points from the first frame with known poses, for captures without points.

Random initial points lead to overfitting, with floaters visible in held-out views. Matched keypoints are precise but
sparse; the plane sweep covers floors, walls and people. Both need the agreement of further views.
"""

import logging
import os
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from structgstream.cameras import Camera, CameraRig, enlargement
from structgstream.data.images import reduced_mask, reduced_picture
from structgstream.data.matching import (
    Features,
    Pair,
    back_project,
    guided_matches,
    inside,
    level_normal,
    neighbor_views,
    project,
    sift_features,
    triangulate,
    unique_pairs,
    viewing_distance,
)
from structgstream.data.plane_sweep import DEFAULT_LEVELS, SweepBounds, SweepConfig, sweep_points
from structgstream.frames import MultiViewFrame
from structgstream.geometry import Floats, Indices

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class PointsConfig:
    """Initial points, for captures without points.

    Keypoints are matched in pictures of at most the reference size (``cameras.enlargement``), the plane sweep reduces
    pictures by itself: pixels are of these. Shares are of the viewing distance (``data.matching.viewing_distance``).
    """

    max_points: int = 60_000
    """Largest number of initial points."""

    MIN_POINTS: ClassVar[int] = 300
    """If fewer points are found, random ones replace them."""
    RANDOM_POINTS: ClassVar[int] = 20_000
    FEATURES: ClassVar[int] = 3000
    """SIFT keypoints per picture."""
    NEIGHBOURS: ClassVar[int] = 4
    """Number of cameras that each camera is matched with."""
    LINE_PIXELS: ClassVar[float] = 1.5
    """Largest distance of a match to its epipolar line."""
    RATIO: ClassVar[float] = 0.85
    """Largest ratio of the best to the second-best descriptor distance along the line."""
    CONFIRM_PIXELS: ClassVar[float] = 2.0
    """Largest reprojection error in a third view."""
    NEAR_SHARE: ClassVar[float] = 0.1
    """Near limit of matching and sweep."""
    FAR_SHARE: ClassVar[float] = 8.0
    """Far limit of matching."""
    CELL_SHARE: ClassVar[float] = 0.004
    """Side of the cells that keep one point each; enlarged if more than ``max_points`` remain."""
    ISOLATION_SHARE: ClassVar[float] = 0.02
    """Side of the cells of the isolation test: points with too few neighbours are removed."""
    SWEEP_LEVELS: ClassVar[tuple[SweepConfig, ...]] = DEFAULT_LEVELS
    """The plane sweeps, fine to coarse; empty for none."""


def initial_points(
    frame: MultiViewFrame, rig: CameraRig, *, config: PointsConfig = PointsConfig(), seed: int = 0
) -> Floats:
    """Points ``[P, 3]`` to start the first frame from, in the capture's units, of the training cameras' pictures and
    poses; held-out pictures are never read.

    Absent cameras and pixels that do not count give no points. Where too few are found, random ones by ``seed`` replace
    them, with a warning. The result does not depend on the number of threads.
    """
    cameras = {name: rig[name] for name in frame.showing(rig.training)}
    images, masks = {name: frame.images[name] for name in cameras}, frame.masks
    distance = viewing_distance(cameras)
    neighbours = neighbor_views(cameras, count=config.NEIGHBOURS, distance=distance)
    workers = max(1, min(len(cameras), os.cpu_count() or 1))
    positions = _sift_points(
        *_at_reference(cameras, images, masks), neighbours, distance=distance, workers=workers, config=config
    )
    if config.SWEEP_LEVELS:
        bounds = _sweep_bounds(cameras, positions, distance=distance, config=config)
        swept = sweep_points(
            cameras, images, masks, neighbours=neighbours, bounds=bounds, workers=workers, levels=config.SWEEP_LEVELS
        )
        positions = np.concatenate([positions, swept])
    selected = np.flatnonzero(_has_neighbors(positions, cell=config.ISOLATION_SHARE * distance))
    selected = selected[_thin_out(positions[selected], cell=config.CELL_SHARE * distance, count=config.max_points)]
    if len(selected) < config.MIN_POINTS:
        _log.warning(
            "Only %d initial points could be triangulated from frame %d (too little texture or overlap); "
            "starting from %d random points in the volume that the cameras see: expect a worse result.",
            len(selected), frame.index, config.RANDOM_POINTS,
        )  # fmt: skip
        return _random_points(cameras, masks, distance=distance, rng=np.random.default_rng(seed), config=config)
    return positions[selected]


def _at_reference(
    cameras: Mapping[str, Camera], images: Mapping[str, NDArray[np.uint8]], masks: Mapping[str, NDArray[np.bool_]]
) -> tuple[dict[str, Camera], dict[str, NDArray[np.uint8]], dict[str, NDArray[np.bool_]]]:
    """The cameras, pictures and masks with what is above the reference size reduced to it (area average).

    Finer keypoints than these gain nothing for seeds, and cost 6 s a picture of 3840 x 2160.
    """
    small = {name: camera.scaled(1 / enlargement(camera.width, camera.height)) for name, camera in cameras.items()}
    pictures = {name: reduced_picture(images[name], max(own.width, own.height)) for name, own in small.items()}
    counting = {name: reduced_mask(masks[name], pictures[name].shape[1::-1]) for name in small if name in masks}
    return small, pictures, counting


def _sift_points(
    cameras: Mapping[str, Camera],
    images: Mapping[str, NDArray[np.uint8]],
    masks: Mapping[str, NDArray[np.bool_]],
    neighbours: Mapping[str, tuple[str, ...]],
    *,
    distance: float,
    workers: int,
    config: PointsConfig,
) -> Floats:
    """Triangulated keypoints that a third view confirms."""
    pairs = unique_pairs(neighbours)
    with ThreadPoolExecutor(workers) as pool:
        found = pool.map(lambda name: sift_features(images[name], count=config.FEATURES, mask=masks.get(name)), cameras)
        features = dict(zip(cameras, found, strict=True))

        def match(pair: Pair) -> Indices:
            first, second = (features[name] for name in pair)
            between = config.NEAR_SHARE * distance, config.FAR_SHARE * distance
            seen = cameras[pair[0]], cameras[pair[1]]
            line, ratio = config.LINE_PIXELS, config.RATIO
            return guided_matches(first, second, seen, line_pixels=line, depth_range=between, ratio=ratio)

        matches = dict(zip(pairs, pool.map(match, pairs), strict=True))
    return _confirm_points(cameras, features, matches, tolerance=config.CONFIRM_PIXELS)


def _confirm_points(
    cameras: Mapping[str, Camera],
    features: Mapping[str, Features],
    matches: Mapping[Pair, Indices],
    *,
    tolerance: float,
) -> Floats:
    """Points ``[P, 3]`` of keypoints whose matches in two other views agree."""
    order = {name: index for index, name in enumerate(cameras)}
    records: list[Floats] = []  # camera, keypoint, other camera, depth, position, pixel in the other camera
    for (first, second), match in matches.items():
        pixels1, pixels2 = features[first].pixels[match[:, 0]], features[second].pixels[match[:, 1]]
        points, depths = triangulate(cameras[first], cameras[second], pixels1, pixels2)
        for side, (own, other, seen) in enumerate(((first, second, pixels2), (second, first, pixels1))):
            own_number, other_number = (np.full(len(match), float(order[name])) for name in (own, other))
            columns = (own_number, match[:, side], other_number, depths[:, side], points, seen)
            records.append(np.column_stack(columns))
    if not records:  # poses under which no two cameras see the same
        return np.empty((0, 3))
    table = np.concatenate(records)
    table = table[np.lexsort((table[:, 3], table[:, 1], table[:, 0]))]
    # Two matches of one keypoint that agree in depth are neighbours after the sort.
    one, two = table[:-1], table[1:]
    agree = (one[:, :2] == two[:, :2]).all(1) & (one[:, 2] != two[:, 2])
    for name, index in order.items():
        for here, there in ((one, two), (two, one)):
            rows = np.flatnonzero(agree & (here[:, 2] == index))
            seen, depths = project(cameras[name], there[rows, 4:7])
            agree[rows] = (depths > 0) & (np.linalg.norm(seen - here[rows, 7:9], axis=1) < tolerance)
    one, two = one[agree], two[agree]
    _, single = np.unique(one[:, :2], axis=0, return_index=True)
    return (one[single, 4:7] + two[single, 4:7]) / 2


def _sweep_bounds(
    cameras: Mapping[str, Camera], points: Floats, *, distance: float, config: PointsConfig
) -> dict[str, SweepBounds]:
    """Ranges of depth and height of the points, with a margin."""
    up = level_normal(cameras)
    low, high = np.percentile(points @ up, [1, 99]).tolist() if len(points) >= 30 else (0.0, 0.0)
    heights = low - 0.1 * distance, high + 0.1 * distance
    return {
        name: SweepBounds(_depth_range(camera, points, distance, config), up if low < high else None, heights)
        for name, camera in cameras.items()
    }


def _depth_range(camera: Camera, points: Floats, distance: float, config: PointsConfig) -> tuple[float, float]:
    """Nearest and farthest depth to sweep: the range of the points in the picture, with a margin."""
    near = max(config.NEAR_SHARE * distance, camera.near)
    pixels, depths = project(camera, points)
    depths = depths[inside(camera, pixels, depths, near=near)]
    if len(depths) < 30:
        return near, max(3 * distance, 2 * near)
    low, high = np.percentile(depths, [1, 99])
    return max(near, 0.6 * float(low)), max(1.3 * float(high), 2 * near)


def _has_neighbors(points: Floats, *, cell: float) -> NDArray[np.bool_]:
    """Mask ``[P]`` of the points with at least three others in the 27 cells around them."""
    if len(points) == 0:
        return np.zeros(0, bool)
    keys, strides = _cells(points, cell)
    occupied, counts = np.unique(keys, return_counts=True)
    total = np.zeros(len(points), np.int64)
    for offset in np.stack(np.meshgrid(*[[-1, 0, 1]] * 3), -1).reshape(-1, 3) @ strides:
        at = np.minimum(np.searchsorted(occupied, keys + offset), len(occupied) - 1)
        total += np.where(occupied[at] == keys + offset, counts[at], 0)
    return total > 3


def _thin_out(points: Floats, *, cell: float, count: int) -> Indices:
    """Indices of one point per cell, of cells grown until at most ``count`` points remain.

    Unlike a random subset, cells keep points in sparse, textureless regions. The first point of a cell is kept, so
    keypoints take precedence over small windows, and these over large ones.
    """
    if len(points) == 0:
        return np.zeros(0, np.intp)
    while True:
        _, firsts = np.unique(_cells(points, cell)[0], return_index=True)
        if len(firsts) <= count:
            return np.sort(firsts)
        cell *= 1.1


def _cells(points: Floats, cell: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """A number ``[P]`` for the cubic cell of each point, and what a step along each axis adds to it."""
    cells = np.floor((points - points.min(0)) / cell).astype(np.int64) + 1
    width, depth = int(cells[:, 0].max()) + 2, int(cells[:, 1].max()) + 2
    strides = np.array([1, width, width * depth])
    return cells @ strides, strides


def _random_points(
    cameras: Mapping[str, Camera],
    masks: Mapping[str, NDArray[np.bool_]],
    *,
    distance: float,
    rng: np.random.Generator,
    config: PointsConfig,
) -> Floats:
    """Random points ``[P, 3]`` in the cameras' views, uniform in inverse depth."""
    positions: list[Floats] = []
    each = -(-config.RANDOM_POINTS // len(cameras))
    for name, camera in cameras.items():
        near = max(config.NEAR_SHARE * distance, camera.near)
        pixels = rng.random((each, 2)) * (camera.width, camera.height)
        inverse = rng.uniform(1 / max(3 * distance, 2 * near), 1 / near, each)
        if name in masks:
            counts = masks[name][tuple(pixels.astype(np.intp).T[::-1])]
            pixels, inverse = pixels[counts], inverse[counts]
        positions.append(back_project(camera, pixels, 1 / inverse))
    return np.concatenate(positions)

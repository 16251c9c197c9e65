# SPDX-License-Identifier: Apache-2.0
"""Plane sweep: depth maps of the training cameras from zero-mean normalised cross-correlation.

Each neighbour's picture is warped by the homographies of planes (Hartley and Zisserman, Multiple View Geometry, chapter
13), spaced evenly in inverse depth (Collins, CVPR 1996); the best half of the neighbours scores a plane, which
tolerates occlusion (Kang, Szeliski and Chai, CVPR 2001). Correlation, because cameras of one rig may differ in exposure
by half.
"""

import math
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from structgstream.cameras import Camera
from structgstream.data.images import opencv, reduced_mask
from structgstream.data.matching import back_project, inside, project, rays_of_pixels
from structgstream.geometry import Floats, Indices
from structgstream.kernels.backend import processor_backend


def plane_homographies(reference: Camera, cameras: Sequence[Camera], planes: Floats) -> Floats:
    """From pixel indices of ``reference`` to those of each of ``N`` cameras, through each plane: ``[P, N, 3, 3]``.

    A plane of ``planes`` ``[P, 3]`` is ``plane . x = 1`` in the axes of ``reference``.
    """
    # The first pixel has the index 0, its centre is at 0.5.
    centred = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])
    to_ray = np.linalg.inv(reference.K.numpy()) @ centred
    found = []
    for camera in cameras:
        relative = camera.viewmat.numpy() @ np.linalg.inv(reference.viewmat.numpy())
        to_pixel = np.linalg.inv(centred) @ camera.K.numpy()
        induced = relative[:3, :3] + relative[:3, 3:] * planes[:, None]
        found.append(to_pixel @ induced @ to_ray)
    return np.stack(found, axis=1)


FloatImage = NDArray[np.float32]


@dataclass(frozen=True)
class SweepConfig:
    """Sampling and acceptance thresholds of the plane sweep."""

    width: int = 240  # width the pictures are reduced to, pixels
    planes: tuple[int, int] = (48, 128)  # fewest and most planes; between them, one per pixel of disparity
    window: int = 5  # side of the correlation window, reduced pixels
    noise: float = 0.008
    """Grey-level noise (full scale 1) added to the variances, so that textureless windows correlate with none."""
    min_score: float = 0.6  # least correlation of an accepted pixel
    min_margin: float = 0.04  # least difference between the score of the best plane and that of any non-adjacent one
    agreement: tuple[float, float] = (1.0, 0.01)
    """Largest difference to another view's depth, in planes and as a share of depth; the looser one applies."""
    views: int = 2  # number of other views that must agree
    level_planes: bool = False  # also sweep horizontal planes, for floors and tables seen at a slant


# Small windows for texture and outlines, then large ones, on pictures reduced until their noise averages out, for
# surfaces with little texture.
DEFAULT_LEVELS = (SweepConfig(), SweepConfig(width=96, window=7, noise=0.001, min_margin=0.03, level_planes=True))


@dataclass(frozen=True)
class SweepBounds:
    """The range of depths that one camera sweeps."""

    depth_range: tuple[float, float]  # nearest and farthest depth along z
    up: Floats | None = None
    """Unit normal ``[3]`` of the level planes (floor, table) in the world; None sweeps no level planes."""
    heights: tuple[float, float] = (0.0, 0.0)  # lowest and highest level plane, along ``up``


@dataclass(frozen=True)
class DepthMap:
    """Depth map of one camera at reduced resolution."""

    camera: Camera  # the camera at the size of the map
    inverse_depth: Floats  # ``[H, W]`` float64, 1 / z
    step: float  # distance of two planes in inverse depth
    believed: NDArray[np.bool_]  # ``[H, W]`` mask of the pixels with a high score and a sufficient margin


@dataclass(frozen=True)
class SweepView:
    """A picture ready for the sweep: reduced camera and grey ``[H, W]`` in [0, 1].

    ``mask`` ``[H, W]`` has the pixels that may get a depth; None for all.
    """

    camera: Camera
    grey: FloatImage
    mask: NDArray[np.bool_] | None = None


def sweep_view(
    camera: Camera, image: NDArray[np.uint8], *, width: int, mask: NDArray[np.bool_] | None = None
) -> SweepView:
    """The picture averaged down to at most ``width`` pixels, with its camera and its mask."""
    cv2 = opencv()
    width = min(width, camera.width)
    height = max(1, round(camera.height * width / camera.width))
    reduced = np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    grey = cv2.cvtColor(reduced.astype(np.float32) / 255, cv2.COLOR_RGB2GRAY)
    mask = None if mask is None else reduced_mask(mask, (width, height))
    return SweepView(camera.resized(width, height), np.asarray(grey, np.float32), mask)


def sweep_depth(
    reference: SweepView, neighbours: Sequence[SweepView], *, bounds: SweepBounds, config: SweepConfig
) -> DepthMap:
    """The best plane of every pixel of ``reference``, over all families of planes."""
    cameras = [view.camera for view in neighbours]
    near, far = bounds.depth_range
    limits = (1 / far, 1 / near)
    families = _families(reference.camera, cameras, bounds, config)
    step = (limits[1] - limits[0]) / (len(families[0].inverse_offsets) - 1)
    (inverse, peak, lead), *others = (_search(reference, neighbours, family, limits, config) for family in families)
    for other_inverse, other_peak, other_lead in others:
        # Margins compare the families only where their depths differ.
        is_other = np.abs(other_inverse - inverse) > 2 * step
        better = other_peak > peak
        gap = np.where(is_other, np.abs(other_peak - peak), np.inf)
        lead = np.minimum(np.where(better, other_lead, lead), gap)
        inverse, peak = np.where(better, other_inverse, inverse), np.maximum(other_peak, peak)
    believed = (peak > config.min_score) & (lead > config.min_margin)
    if reference.mask is not None:
        believed &= reference.mask
    return DepthMap(reference.camera, inverse, step, believed)


def consistent_pixels(
    depth_map: DepthMap, others: Sequence[DepthMap], *, config: SweepConfig
) -> tuple[Floats, NDArray[np.bool_]]:
    """The points ``[P, 3]`` of the believed pixels whose depth enough other maps confirm.

    A point is the mean of its own estimate and those of the agreeing views. The mask ``[H, W]`` has the points' pixels
    in row order.
    """
    row, column = np.nonzero(depth_map.believed)
    pixels = np.stack([column, row], 1).astype(np.float64) + 0.5
    points = back_project(depth_map.camera, pixels, 1 / depth_map.inverse_depth[row, column])
    total = points.copy()
    agreeing, looking = np.zeros(len(points), np.intp), np.zeros(len(points), np.intp)
    for other in others:
        seen, confirmed, estimate = _agreement(points, depth_map, pixels, other, config)
        agreeing[confirmed] += 1
        total[confirmed] += estimate
        looking[seen] += 1
    # At the edge of the common volume, where only one other camera sees the point, that one suffices.
    enough = agreeing >= np.clip(looking, 1, config.views)
    mask = np.zeros(depth_map.believed.shape, bool)
    mask[row[enough], column[enough]] = True
    return total[enough] / (agreeing[enough, None] + 1), mask


def sweep_points(
    cameras: Mapping[str, Camera],
    images: Mapping[str, NDArray[np.uint8]],
    masks: Mapping[str, NDArray[np.bool_]],
    *,
    neighbours: Mapping[str, tuple[str, ...]],
    bounds: Mapping[str, SweepBounds],
    workers: int,
    levels: Sequence[SweepConfig],
) -> Floats:
    """Consistent points ``[P, 3]`` from depth maps of all ``cameras``; ``images`` ``[H, W, 3]`` uint8, of whose pixels
    ``masks`` ``[H, W]`` leave some out.

    A later level adds points only where earlier ones have none nearby, because large windows extend surfaces over
    outlines.
    """
    cv2 = opencv()
    names = [name for name in cameras if neighbours[name]]
    positions: list[Floats] = [np.empty((0, 3))]
    covered: dict[str, FloatImage] = {}
    with ThreadPoolExecutor(workers) as pool:
        for config in levels:
            views = {
                name: sweep_view(camera, images[name], width=config.width, mask=masks.get(name))
                for name, camera in cameras.items()
            }

            def swept(name: str, views: Mapping[str, SweepView] = views, config: SweepConfig = config) -> DepthMap:
                others = [views[other] for other in neighbours[name]]
                return sweep_depth(views[name], others, bounds=bounds[name], config=config)

            maps = dict(zip(names, pool.map(swept, names), strict=True))
            for name in names:
                others = [other for other_name, other in maps.items() if other_name != name]
                points, mask = consistent_pixels(maps[name], others, config=config)
                height, width = mask.shape
                before = covered.get(name, np.zeros(mask.shape, np.float32))
                before = cv2.resize(before, (width, height), interpolation=cv2.INTER_AREA)
                reach = config.window // 2 | 1
                blank = cv2.boxFilter(before, -1, (reach, reach)) < 0.02
                positions.append(points[blank[mask]])
                covered[name] = np.maximum(before, mask)
    return np.concatenate(positions)


def _agreement(
    points: Floats, own: DepthMap, pixels: Floats, other: DepthMap, config: SweepConfig
) -> tuple[Indices, Indices, Floats]:
    """Indices of the ``points`` in the other picture, of those that its map confirms, and its estimates of these."""
    projected, depths = project(other.camera, points)
    seen = np.flatnonzero(inside(other.camera, projected, depths, near=0.0))
    column, row = projected[seen].astype(np.intp).T
    inverse = other.inverse_depth[row, column]
    planes, share = config.agreement
    tolerance = np.maximum(planes * other.step, share * inverse)
    close = other.believed[row, column] & (np.abs(inverse - 1 / depths[seen]) < tolerance)
    confirmed = seen[close]
    # The other view's depth along the ray through this very point, so that no pixel grid shows in the mean.
    estimate = back_project(other.camera, projected[confirmed], 1 / inverse[close])
    returned, _ = project(own.camera, estimate)
    near_pixel = np.linalg.norm(returned - pixels[confirmed], axis=1) < 1.5
    return seen, confirmed[near_pixel], estimate[near_pixel]


@dataclass(frozen=True)
class _Family:
    """Parallel planes ``normal . x = offset`` in the reference camera's axes, even in ``1 / offset``."""

    normal: Floats
    inverse_offsets: Floats


def _families(camera: Camera, others: Sequence[Camera], bounds: SweepBounds, config: SweepConfig) -> list[_Family]:
    """Planes parallel to the picture, then level planes under and over the camera (Gallup et al., CVPR 2007).

    Floors and tables are seen at a slant: on planes parallel to the picture wide windows do not match there.
    """
    near, far = bounds.depth_range
    axis = camera.viewmat.numpy()[2, :3]
    bases = [other.center.numpy() - camera.center.numpy() for other in others]
    across = float(np.median([np.linalg.norm(base - (base @ axis) * axis) for base in bases]))
    pixels_per_inverse = float(camera.K[0, 0]) * across
    count = int(np.clip(math.ceil(pixels_per_inverse * (1 / near - 1 / far)), *config.planes))
    families = [_Family(np.array([0.0, 0.0, 1.0]), np.linspace(1 / far, 1 / near, count))]
    if bounds.up is None or not config.level_planes:
        return families
    normal = camera.viewmat.numpy()[:3, :3] @ bounds.up
    slant = np.abs(rays_of_pixels(camera) @ normal).max()
    for height in bounds.heights:
        offset = height - float(bounds.up @ camera.center.numpy())
        # A plane near the lens' own height is seen edge on.
        close = math.copysign(0.1 * far, offset)
        if abs(offset) > 1.5 * abs(close):
            span = pixels_per_inverse * slant * abs(1 / close - 1 / offset)
            count = int(np.clip(math.ceil(span), 8, config.planes[1]))
            families.append(_Family(normal, np.linspace(1 / offset, 1 / close, count)))
    return families


def _search(
    reference: SweepView,
    neighbours: Sequence[SweepView],
    family: _Family,
    limits: tuple[float, float],
    config: SweepConfig,
) -> tuple[Floats, Floats, Floats]:
    """Inverse depth, score and margin over the best non-adjacent plane ``[H, W]`` of one family; -1 without a peak.

    The plane is refined by a parabola through the scores around it.
    """
    offsets = family.inverse_offsets
    tilt = rays_of_pixels(reference.camera) @ family.normal
    cameras = [view.camera for view in neighbours]
    homographies = plane_homographies(reference.camera, cameras, offsets[:, None] * family.normal)
    own, others = torch.from_numpy(reference.grey), [torch.from_numpy(view.grey) for view in neighbours]
    found = processor_backend().plane_scores(
        own, others, torch.from_numpy(homographies), window=config.window, noise=config.noise**2
    )
    scores = found.numpy()
    margin = 0.01 * limits[1]
    for number, offset in enumerate(offsets):
        inverse_depth = tilt * offset
        outside = (inverse_depth < limits[0] - margin) | (inverse_depth > limits[1] + margin)
        scores[number][outside] = -1
    last = len(offsets) - 1
    best = scores.argmax(0)
    peak = np.take_along_axis(scores, best[None], 0)[0]
    before = np.take_along_axis(scores, np.maximum(best - 1, 0)[None], 0)[0]
    after = np.take_along_axis(scores, np.minimum(best + 1, last)[None], 0)[0]
    for offset in range(-2, 3):  # Clipped indices lie among the five, too.
        np.put_along_axis(scores, np.clip(best + offset, 0, last)[None], -1, 0)
    rival = scores.max(0)
    interior = (best > 0) & (best < last) & (before > -1) & (after > -1)
    bend = np.maximum(2 * peak - before - after, 1e-6)
    shift = np.where(interior, np.clip((after - before) / (2 * bend), -0.5, 0.5), 0.0)
    step = (offsets[-1] - offsets[0]) / last
    inverse = np.maximum(tilt * (offsets[0] + (best + shift) * step), 1e-12)
    return inverse, peak, np.where(interior, peak - rival, -1)

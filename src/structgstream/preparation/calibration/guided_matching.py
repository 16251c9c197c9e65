# SPDX-License-Identifier: Apache-2.0
"""Matches of keypoints near each other's epipolar lines, once poses are known roughly.

Among all keypoints of a picture many look alike; among those of one epipolar plane few do. So a camera whose scene has
little texture gets several times the matches that it has without poses.
"""

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from structgstream.data.arrays import Floats
from structgstream.data.lenses import LensCamera
from structgstream.data.matching import Pair, distinct_best
from structgstream.preparation.calibration.keypoints import Keypoints
from structgstream.preparation.calibration.posed_matches import camera_rays, epipolar_angles

Indices = NDArray[np.intp]

LEAST_SINE = 0.02  # rays along the baseline belong to every epipolar plane


@dataclass(frozen=True)
class GuidedMatchConfig:
    """How keypoints of cameras with rough poses are matched.

    Args:
        ratio: largest ratio of the best descriptor distance in an epipolar plane to that of a rival.
        distance: largest descriptor distance; unit descriptors are at most sqrt(2) apart.
        distinct_pixels: keypoints that lie closer than this to the best one are no rivals of it.
        degrees: largest angle between the optical axes of two cameras that are matched.
    """

    ratio: float = 0.8
    distance: float = 0.8
    distinct_pixels: float = 4.0
    degrees: float = 70.0


def guided_matches(
    keypoints: Mapping[str, Keypoints],
    cameras: Mapping[str, LensCamera],
    *,
    pixels: float,
    workers: int,
    config: GuidedMatchConfig = GuidedMatchConfig(),
) -> dict[Pair, NDArray[np.uint32]]:
    """Matches of cameras that look the same way: each other's best ones among those near one epipolar plane.

    Args:
        keypoints: by camera.
        cameras: with their rough poses.
        pixels: how far from the plane a keypoint may lie.
        workers: threads.
        config: what counts as alike.

    Returns:
        ``[S, 2]`` by pair of cameras: indices of the keypoints of the first and of the second.
    """
    rays = {name: camera_rays(filmed, keypoints[name].pixels) for name, filmed in cameras.items()}

    def one(pair: Pair) -> NDArray[np.uint32]:
        first, second = pair
        row, column = _near_planes((cameras[first], cameras[second]), (rays[first], rays[second]), pixels=pixels)
        return _best((keypoints[first], keypoints[second]), row, column, config=config)

    pairs = _facing(cameras, degrees=config.degrees)
    with ThreadPoolExecutor(workers) as pool:
        return dict(zip(pairs, pool.map(one, pairs), strict=True))


def _facing(cameras: Mapping[str, LensCamera], *, degrees: float) -> Sequence[Pair]:
    names = list(cameras)
    axes = np.stack([cameras[name].camera.viewmat[2, :3].numpy() for name in names])
    near = axes @ axes.T > np.cos(np.radians(degrees))
    return [(names[one], names[two]) for one, two in zip(*np.nonzero(np.triu(near, 1)), strict=True)]


def _near_planes(
    cameras: tuple[LensCamera, LensCamera], rays: tuple[Floats, Floats], *, pixels: float
) -> tuple[Indices, Indices]:
    """Which keypoints of two cameras lie within ``pixels`` of one epipolar plane, as indices ``[C]`` into both lists.

    Rays of one epipolar plane have one angle about the baseline. The second camera's are sorted by it, so that only
    neighbours are looked at.
    """
    none = np.empty(0, np.intp)
    base = (cameras[1].camera.center - cameras[0].camera.center).numpy()
    if not np.linalg.norm(base) > 0:
        return none, none
    base = base / np.linalg.norm(base)
    across = np.cross(base, np.eye(3)[np.abs(base).argmin()])
    across /= np.linalg.norm(across)
    turns = [np.arctan2(ray @ np.cross(base, across), ray @ across) for ray in rays]
    sines = [np.linalg.norm(np.cross(base, ray), axis=1) for ray in rays]
    usable = [np.flatnonzero(np.isfinite(turn) & (sine > LEAST_SINE)) for turn, sine in zip(turns, sines, strict=True)]
    if not len(usable[0]) or not len(usable[1]):
        return none, none
    slack = pixels / max(float(filmed.camera.K[0, 0]) for filmed in cameras)
    # A pair is near a plane if the smaller of its sines makes it so; the smallest sine of the second list bounds it.
    width = slack / np.minimum(sines[0][usable[0]], float(sines[1][usable[1]].min()))
    order = usable[1][np.argsort(turns[1][usable[1]], kind="stable")]
    sorted_turns = turns[1][order]
    around = np.concatenate([sorted_turns - 2 * np.pi, sorted_turns, sorted_turns + 2 * np.pi])
    start, end = (np.searchsorted(around, turns[0][usable[0]] + side * np.minimum(width, np.pi)) for side in (-1, 1))
    count = end - start
    row = np.repeat(usable[0], count)
    within = np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count)
    column = order[(np.repeat(start, count) + within) % len(order)]
    near = epipolar_angles(cameras, (rays[0][row], rays[1][column])) < slack
    return row[near], column[near]


def _best(
    keypoints: tuple[Keypoints, Keypoints], row: Indices, column: Indices, *, config: GuidedMatchConfig
) -> NDArray[np.uint32]:
    """The mutually best ones of the candidates that share an instant."""
    first, second = keypoints
    together = (first.seen[row] & second.seen[column]).any(1)
    row, column = row[together], column[together]
    alike = np.einsum("sd,sd->s", first.descriptors[row], second.descriptors[column])
    cost = np.sqrt(np.maximum(2 - 2 * alike, 1e-12))
    there = distinct_best(
        row, column, cost, second.pixels, ratio=config.ratio, distinct_pixels=config.distinct_pixels
    )  # fmt: skip
    back = distinct_best(column, row, cost, first.pixels, ratio=config.ratio, distinct_pixels=config.distinct_pixels)
    kept = np.intersect1d(there, back)
    kept = kept[cost[kept] < config.distance]
    return np.stack([row[kept], column[kept]], 1).astype(np.uint32)

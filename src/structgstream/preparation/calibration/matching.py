# SPDX-License-Identifier: Apache-2.0
"""Which keypoints of cameras match: without poses, with rough ones, and which matches agree with poses.

Among all keypoints of a picture many look alike; among those of one epipolar plane few do. So a camera whose scene has
little texture gets several times the matches once poses are known roughly.
"""

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from structgstream.data.lenses import LensCamera
from structgstream.data.matching import Features, Pair, mutual_matches, mutually_best
from structgstream.geometry import Floats
from structgstream.preparation.calibration.keypoints import Keypoints

Indices = NDArray[np.intp]
MIN_SINE = 0.02  # rays along the baseline belong to every epipolar plane


RATIO = 0.85  # largest ratio of the best to the second-best descriptor distance
GUIDED_RATIO = 0.8  # the same of the best in an epipolar plane to its rivals
MAX_DISTANCE = 0.8  # of the descriptors of a match; unit descriptors are at most sqrt(2) apart
DISTINCT_PIXELS = 4.0  # keypoints that lie closer than this to the best one are no rivals of it
FACING_DEGREES = 70.0  # largest angle between the optical axes of two cameras that are matched


def keypoint_matches(first: Keypoints, second: Keypoints) -> NDArray[np.uint32]:
    """Mutually best matches ``[S, 2]``, indices into the two lists, of keypoints that share an instant."""
    seen = None if first.seen.shape[1] == 1 else (first.seen, second.seen)
    found = mutual_matches(first.descriptors, second.descriptors, ratio=RATIO, distance=MAX_DISTANCE, seen=seen)
    return found.astype(np.uint32)


def all_matches(keypoints: Mapping[str, Keypoints], *, workers: int) -> dict[Pair, NDArray[np.uint32]]:
    """:func:`keypoint_matches` of every pair of cameras."""
    pairs = list(combinations(keypoints, 2))
    with ThreadPoolExecutor(workers) as pool:
        found = pool.map(lambda pair: keypoint_matches(keypoints[pair[0]], keypoints[pair[1]]), pairs)
        return dict(zip(pairs, found, strict=True))


def camera_rays(filmed: LensCamera, pixels: Floats) -> Floats:
    """Unit directions ``[S, 3]`` in the world of pixels as filmed; NaN where the lens shows nothing."""
    flat = filmed.to_normalized(pixels)
    rays = np.concatenate([flat, np.ones((len(flat), 1))], 1) @ filmed.camera.viewmat[:3, :3].numpy()
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def epipolar_angles(cameras: tuple[LensCamera, LensCamera], rays: tuple[Floats, Floats]) -> Floats:
    """Angle ``[S]`` in radians of each pair of rays to their epipolar plane, the larger one of the two cameras.

    Rays that meet behind the cameras count as being a right angle off.
    """
    base = (cameras[1].camera.center - cameras[0].camera.center).numpy()
    length = np.linalg.norm(base)
    if length == 0:
        return np.arccos(np.clip((rays[0] * rays[1]).sum(1), -1, 1))
    base = base / length
    volume = np.abs((np.cross(base, rays[0]) * rays[1]).sum(1))
    widest = [np.linalg.norm(np.cross(base, ray), axis=1) for ray in rays]
    angles = np.arcsin(np.clip(volume / np.maximum(np.minimum(*widest), 1e-12), 0, 1))
    # In the epipolar plane the two rays turn towards each other, unless they meet behind.
    ahead = (rays[0] @ base) - (rays[1] @ base) > -1e-3
    return np.where(ahead, angles, np.pi / 2)


def agreeing_matches(
    keypoints: Mapping[str, Keypoints],
    matches: Mapping[Pair, NDArray[np.uint32]],
    cameras: Mapping[str, LensCamera],
    *,
    degrees: float,
) -> dict[Pair, NDArray[np.uint32]]:
    """The matches whose rays pass within ``degrees`` of their epipolar plane."""
    found = _plane_angles(keypoints, matches, cameras)
    return {pair: matches[pair][angles < np.radians(degrees)] for pair, angles in found.items()}


def epipolar_pixels(
    keypoints: Mapping[str, Keypoints],
    matches: Mapping[Pair, NDArray[np.uint32]],
    cameras: Mapping[str, LensCamera],
) -> dict[Pair, Floats]:
    """Distance of each match to its epipolar plane, in pixels of the longer of the two focal lengths."""
    focal = {name: float(filmed.camera.K[0, 0]) for name, filmed in cameras.items()}
    found = _plane_angles(keypoints, matches, cameras)
    return {(one, two): max(focal[one], focal[two]) * angles for (one, two), angles in found.items()}


def _plane_angles(
    keypoints: Mapping[str, Keypoints],
    matches: Mapping[Pair, NDArray[np.uint32]],
    cameras: Mapping[str, LensCamera],
) -> dict[Pair, Floats]:
    """:func:`epipolar_angles` ``[S]`` of the matches of each pair."""
    rays = {name: camera_rays(cameras[name], keypoints[name].pixels) for name in cameras}
    return {
        (one, two): epipolar_angles((cameras[one], cameras[two]), (rays[one][rows[:, 0]], rays[two][rows[:, 1]]))
        for (one, two), rows in matches.items()
    }


def guided_matches(
    keypoints: Mapping[str, Keypoints],
    cameras: Mapping[str, LensCamera],
    *,
    pixels: float,
    workers: int,
) -> dict[Pair, NDArray[np.uint32]]:
    """Matches of cameras that look the same way: each other's best ones among those near one epipolar plane.

    Args:
        keypoints: by camera.
        cameras: with their rough poses.
        pixels: how far from the plane a keypoint may lie.
        workers: threads.

    Returns:
        ``[S, 2]`` by pair of cameras: indices of the keypoints of the first and of the second.
    """
    rays = {name: camera_rays(filmed, keypoints[name].pixels) for name, filmed in cameras.items()}

    def one(pair: Pair) -> NDArray[np.uint32]:
        first, second = pair
        row, column = _near_planes((cameras[first], cameras[second]), (rays[first], rays[second]), pixels=pixels)
        return _best((keypoints[first], keypoints[second]), row, column)

    pairs = _facing(cameras)
    with ThreadPoolExecutor(workers) as pool:
        return dict(zip(pairs, pool.map(one, pairs), strict=True))


def _facing(cameras: Mapping[str, LensCamera]) -> Sequence[Pair]:
    names = list(cameras)
    axes = np.stack([cameras[name].camera.viewmat[2, :3].numpy() for name in names])
    near = axes @ axes.T > np.cos(np.radians(FACING_DEGREES))
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
    usable = [np.flatnonzero(np.isfinite(turn) & (sine > MIN_SINE)) for turn, sine in zip(turns, sines, strict=True)]
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


def _best(keypoints: tuple[Keypoints, Keypoints], row: Indices, column: Indices) -> NDArray[np.uint32]:
    """The mutually best ones of the candidates that share an instant."""
    first, second = keypoints
    together = (first.seen[row] & second.seen[column]).any(1)
    row, column = row[together], column[together]
    found = mutually_best(
        Features(first.pixels, first.descriptors),
        Features(second.pixels, second.descriptors),
        row,
        column,
        ratio=GUIDED_RATIO,
        distinct_pixels=DISTINCT_PIXELS,
        distance=MAX_DISTANCE,
    )
    return found.astype(np.uint32)

# SPDX-License-Identifier: Apache-2.0
"""Keypoints of a still camera over several instants, as one list, and which of them match those of other cameras.

A camera that stands still has one pose at all instants, so its pictures give one set of observations. What stands
still is found again at every instant and counts once; what moves adds keypoints. Each keypoint has a mask of the
instants at which it was seen, because keypoints of two cameras can only be of one point if they share an instant.

Among all keypoints of a picture many look alike; among those of one epipolar plane few do. So a camera whose scene has
little texture gets several times the matches once poses are known roughly.
"""

import os
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import combinations
from threading import Event
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from structgstream.data.images import opencv, reduced_picture
from structgstream.data.lenses import LensCamera
from structgstream.data.matching import Features, Pair, mutual_matches, mutually_best
from structgstream.geometry import Floats, Indices
from structgstream.preparation.calibration.colmap import pycolmap_module

MAX_KEYPOINTS = 6000  # of one picture, the largest first
LONGEST_SIDE = 1600  # pixels, to which larger pictures are reduced
PEAK_THRESHOLD = 0.004  # smallest contrast of a keypoint, as a share of the range of the picture
SAME_PIXELS, SAME_SIMILARITY = 1.0, 0.85  # largest distance and smallest cosine of one keypoint at two instants
INSTANTS = 3  # that are looked at before keypoints are counted, and then again
ENOUGH = 6000
"""Keypoints of a camera, in the median over cameras, beyond which no further instants are looked at. Where little has
texture, people who move about add keypoints."""


WORKERS = min(os.cpu_count() or 1, 16)  # threads, each of which holds the pyramid of a picture
Key = TypeVar("Key")
Value = TypeVar("Value")


@dataclass(frozen=True)
class Keypoints(Features):
    """Keypoints of one camera."""

    seen: NDArray[np.bool_]  # ``[S, T]``, at which instants

    def __len__(self) -> int:
        return len(self.pixels)


def _merged(known: Keypoints, instant: int, pixels: Floats, descriptors: NDArray[np.float32]) -> Keypoints:
    """``known`` and the keypoints of one more instant; those that repeat known ones count once."""
    which = _repeated(known, pixels, descriptors)
    seen = known.seen.copy()
    seen[which[which >= 0], instant] = True
    fresh = which < 0
    now = np.zeros((int(fresh.sum()), seen.shape[1]), bool)
    now[:, instant] = True
    return Keypoints(
        np.concatenate([known.pixels, pixels[fresh]]),
        np.concatenate([known.descriptors, descriptors[fresh]]),
        np.concatenate([seen, now]),
    )


def of_each(keys: Collection[Key], function: Callable[[Key], Value]) -> dict[Key, Value]:
    """The results of ``function`` by what it is of, in threads."""
    with ThreadPoolExecutor(WORKERS) as pool:
        return dict(zip(keys, pool.map(function, keys), strict=True))


def all_keypoints(pictures: Mapping[str, Sequence[NDArray[np.uint8]]]) -> dict[str, Keypoints]:
    """Covariant SIFT keypoints with domain-size pooling of still cameras' pictures ``[H, W, 3]``, one an instant; those
    of a camera are merged. From as many instants as give enough; an interruption is noticed between two pictures.

    Affine shapes and pooled descriptors (Mikolajczyk and Schmid, IJCV 2004; Dong and Soatto, CVPR 2015) match over
    wider baselines than plain SIFT.
    """
    order = spread_order(min(map(len, pictures.values()), default=0))
    found: dict[str, Keypoints] = {}
    for start in range(0, len(order), INSTANTS):
        found = _with_instants(pictures, found, sorted(order[start : start + INSTANTS]))
        if np.median([len(own) for own in found.values()]) >= ENOUGH:
            break
    return found


def _with_instants(
    pictures: Mapping[str, Sequence[NDArray[np.uint8]]], known: Mapping[str, Keypoints], instants: Sequence[int]
) -> dict[str, Keypoints]:
    stopping = Event()

    def one(name: str) -> Keypoints:
        extractor, seen = _extractor(), np.zeros((0, len(pictures[name])), bool)
        found = known.get(name) or Keypoints(np.empty((0, 2)), np.empty((0, 128), np.float32), seen)
        for instant in instants:
            if stopping.is_set():
                raise CancelledError
            found = _merged(found, instant, *_extracted(extractor, pictures[name][instant]))
        return found

    with ThreadPoolExecutor(WORKERS) as pool:
        try:
            return dict(zip(pictures, pool.map(one, pictures), strict=True))
        except BaseException:
            stopping.set()  # the pool waits for its threads, which would go on for minutes
            raise


def spread_order(count: int) -> list[int]:
    """Numbers below ``count`` in an order of which every beginning is spread: the first, the last, the middle."""
    order = [0, count - 1][:count]
    while len(order) < count:
        distance = np.abs(np.arange(count)[:, None] - order).min(1)
        order.append(int(distance.argmax()))
    return order


def _extractor() -> Any:
    pycolmap = pycolmap_module()
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = 1
    options.use_gpu = False
    options.sift.max_num_features = MAX_KEYPOINTS
    options.sift.peak_threshold = PEAK_THRESHOLD
    options.sift.estimate_affine_shape = True
    options.sift.domain_size_pooling = True
    return pycolmap.FeatureExtractor.create(options)


def _extracted(extractor: Any, picture: NDArray[np.uint8]) -> tuple[Floats, NDArray[np.float32]]:
    """Pixels of the whole picture, and unit descriptors."""
    cv2 = opencv()
    grey = cv2.cvtColor(np.ascontiguousarray(picture), cv2.COLOR_RGB2GRAY)
    height, width = grey.shape
    grey = reduced_picture(grey, LONGEST_SIDE)
    listed, stored = extractor.extract_from_uint8_array(grey)
    places = pycolmap_module().keypoints_to_matrix(listed)[:, :2].astype(np.float64)
    descriptors = np.asarray(stored.data).astype(np.float32)
    norms = np.linalg.norm(descriptors, axis=1, keepdims=True)
    return places * (width / grey.shape[1], height / grey.shape[0]), descriptors / np.maximum(norms, 1e-9)


def roving_keypoints(pictures: Mapping[str, NDArray[np.uint8]], *, instants: int) -> dict[str, Keypoints]:
    """Keypoints of each frame of a roving camera; they are matched with those of any of ``instants`` instants."""
    found = _with_instants({name: [picture] for name, picture in pictures.items()}, {}, [0])
    return {name: replace(own, seen=np.ones((len(own), instants), bool)) for name, own in found.items()}


def _repeated(known: Keypoints, pixels: Floats, descriptors: NDArray[np.float32]) -> Indices:
    """For each of the new keypoints the known one that it repeats, or -1."""
    from scipy.spatial import KDTree

    which = np.full(len(pixels), -1, np.intp)
    if len(known) == 0 or len(pixels) == 0:
        return which
    trees = KDTree(known.pixels), KDTree(pixels)
    near = trees[0].sparse_distance_matrix(trees[1], SAME_PIXELS, output_type="coo_matrix").tocoo()
    alike = np.einsum("sd,sd->s", known.descriptors[near.row], descriptors[near.col])
    order = np.argsort(alike, kind="stable")
    order = order[alike[order] > SAME_SIMILARITY]
    which[near.col[order]] = near.row[order]  # the last write is the most alike
    return which


MIN_SINE = 0.02  # rays along the baseline belong to every epipolar plane
RATIO = 0.85  # largest ratio of the best to the second-best descriptor distance
GUIDED_RATIO = 0.8  # the same of the best in an epipolar plane to its rivals
MAX_DISTANCE = 0.8  # of the descriptors of a match; unit descriptors are at most sqrt(2) apart
FACING_DEGREES = 70.0  # largest angle between the optical axes of two cameras that are matched


def keypoint_matches(first: Keypoints, second: Keypoints) -> NDArray[np.uint32]:
    """Mutually best matches ``[S, 2]``, indices into the two lists, of keypoints that share an instant."""
    seen = None if first.seen.shape[1] == 1 else (first.seen, second.seen)
    found = mutual_matches(first.descriptors, second.descriptors, ratio=RATIO, distance=MAX_DISTANCE, seen=seen)
    return found.astype(np.uint32)


def all_matches(
    keypoints: Mapping[str, Keypoints], pairs: Sequence[Pair] | None = None
) -> dict[Pair, NDArray[np.uint32]]:
    """:func:`keypoint_matches` of every pair of cameras, or of some."""
    pairs = list(combinations(keypoints, 2)) if pairs is None else pairs
    return of_each(pairs, lambda pair: keypoint_matches(keypoints[pair[0]], keypoints[pair[1]]))


def camera_rays(filmed: LensCamera, pixels: Floats) -> Floats:
    """Unit directions ``[S, 3]`` in the world of pixels as filmed; NaN where the lens shows nothing."""
    flat = filmed.to_normalized(pixels)
    rays = np.concatenate([flat, np.ones((len(flat), 1))], 1) @ filmed.camera.viewmat[:3, :3].numpy()
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def epipolar_angles(cameras: tuple[LensCamera, ...], rays: tuple[Floats, ...]) -> Floats:
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
    keypoints: Mapping[str, Keypoints], cameras: Mapping[str, LensCamera], *, pixels: float
) -> dict[Pair, NDArray[np.uint32]]:
    """Matches ``[S, 2]`` of cameras that look the same way: each other's best ones among those near one epipolar plane.

    ``cameras`` have their rough poses; keypoints may lie ``pixels`` from the plane.
    """
    rays = {name: camera_rays(filmed, keypoints[name].pixels) for name, filmed in cameras.items()}

    def one(pair: Pair) -> NDArray[np.uint32]:
        first, second = (keypoints[name] for name in pair)
        own = tuple(cameras[name] for name in pair), tuple(rays[name] for name in pair)
        row, column = _near_planes(*own, pixels=pixels)
        together = (first.seen[row] & second.seen[column]).any(1)
        found = mutually_best(first, second, row[together], column[together], ratio=GUIDED_RATIO, distance=MAX_DISTANCE)
        return found.astype(np.uint32)

    return of_each(_facing(cameras), one)


def _facing(cameras: Mapping[str, LensCamera]) -> Sequence[Pair]:
    names = list(cameras)
    axes = np.stack([cameras[name].camera.viewmat[2, :3].numpy() for name in names])
    near = axes @ axes.T > np.cos(np.radians(FACING_DEGREES))
    return [(names[one], names[two]) for one, two in zip(*np.nonzero(np.triu(near, 1)), strict=True)]


def _near_planes(
    cameras: tuple[LensCamera, ...], rays: tuple[Floats, ...], *, pixels: float
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

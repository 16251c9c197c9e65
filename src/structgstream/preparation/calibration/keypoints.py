# SPDX-License-Identifier: Apache-2.0
"""Keypoints of a still camera over several instants, as one list.

A camera that stands still has one pose at all instants, so its pictures give one set of observations. What stands
still is found again at every instant and is kept once; what moves adds keypoints. Each keypoint remembers at which
instants it was seen, because keypoints of two cameras can only be of one point if they share an instant.
"""

from collections.abc import Mapping, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from dataclasses import dataclass
from threading import Event
from typing import Any

import numpy as np
from numpy.typing import NDArray

from structgstream.data.arrays import Floats
from structgstream.data.images import opencv, reduced_picture
from structgstream.preparation.calibration.colmap import pycolmap_module


@dataclass(frozen=True)
class KeypointConfig:
    """How keypoints are found.

    Args:
        count: most keypoints of one picture, the largest first.
        longest_side: pictures with a longer side are reduced to it, pixels.
        peak_threshold: least contrast of a keypoint, of the range of the picture.
        same_pixels: keypoints of two instants are one if they lie as close as this and look alike.
        same_similarity: least cosine of their descriptors.
        instants: how many pictures of a camera are looked at before they are counted, and then again.
        enough: keypoints of a camera, in the median over cameras, beyond which no further pictures are looked at. Where
            little has texture, people who move about add them.
    """

    count: int = 6000
    longest_side: int = 1600
    peak_threshold: float = 0.004
    same_pixels: float = 1.0
    same_similarity: float = 0.85
    instants: int = 3
    enough: int = 6000


@dataclass(frozen=True)
class Keypoints:
    """Keypoints of one camera.

    Args:
        pixels: ``[S, 2]``, the top-left pixel's centre at (0.5, 0.5).
        descriptors: ``[S, 128]`` of unit length (RootSIFT).
        seen: ``[S, T]``, at which instants.
    """

    pixels: Floats
    descriptors: NDArray[np.float32]
    seen: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.pixels)


def camera_keypoints(
    pictures: Sequence[NDArray[np.uint8]],
    masks: Sequence[NDArray[np.bool_]] | None = None,
    *,
    config: KeypointConfig = KeypointConfig(),
    instants: Sequence[int] | None = None,
    known: Keypoints | None = None,
    stopping: Event | None = None,
) -> Keypoints:
    """Covariant SIFT keypoints with domain-size pooling of a still camera's ``pictures [H, W, 3]``, merged.

    Affine shapes and pooled descriptors (Mikolajczyk and Schmid, IJCV 2004; Dong and Soatto, CVPR 2015) match over
    wider baselines than plain SIFT. ``masks [H, W]`` are True where a picture counts.

    Args:
        instants: which of the pictures are looked at; all by default.
        known: what others of them gave.
        stopping: when it is set, no further picture is looked at.

    Raises:
        CancelledError: ``stopping`` was set.
        MissingExtraError: cv2 or pycolmap is not installed.
    """
    extractor = _extractor(config)
    count = len(pictures)
    found = known or Keypoints(np.empty((0, 2)), np.empty((0, 128), np.float32), np.zeros((0, count), bool))
    for instant in range(count) if instants is None else instants:
        if stopping is not None and stopping.is_set():
            raise CancelledError
        mask = None if masks is None else masks[instant]
        now = _extracted(extractor, pictures[instant], mask, longest_side=config.longest_side)
        found = _merged(found, instant, *now, config=config)
    return found


def _merged(
    known: Keypoints, instant: int, found: Floats, looks: NDArray[np.float32], *, config: KeypointConfig
) -> Keypoints:
    """What is known, and the keypoints of one more instant; those that repeat known ones are kept once."""
    which = _repeated(known.pixels, known.descriptors, found, looks, config=config)
    seen = known.seen.copy()
    seen[which[which >= 0], instant] = True
    fresh = which < 0
    now = np.zeros((int(fresh.sum()), seen.shape[1]), bool)
    now[:, instant] = True
    return Keypoints(
        np.concatenate([known.pixels, found[fresh]]),
        np.concatenate([known.descriptors, looks[fresh]]),
        np.concatenate([seen, now]),
    )


def all_keypoints(
    pictures: Mapping[str, Sequence[NDArray[np.uint8]]],
    masks: Mapping[str, Sequence[NDArray[np.bool_]]] | None,
    *,
    workers: int,
    config: KeypointConfig = KeypointConfig(),
) -> dict[str, Keypoints]:
    """:func:`camera_keypoints` of every camera, from as many instants as give enough; ``masks`` may lack cameras.

    An interruption is heard between two pictures.
    """
    order = spread_order(min(map(len, pictures.values()), default=0))
    found: dict[str, Keypoints] = {}
    for start in range(0, len(order), config.instants):
        instants = sorted(order[start : start + config.instants])
        found = _each(pictures, masks, found, instants, workers=workers, config=config)
        if np.median([len(own) for own in found.values()]) >= config.enough:
            break
    return found


def _each(
    pictures: Mapping[str, Sequence[NDArray[np.uint8]]],
    masks: Mapping[str, Sequence[NDArray[np.bool_]]] | None,
    known: Mapping[str, Keypoints],
    instants: Sequence[int],
    *,
    workers: int,
    config: KeypointConfig,
) -> dict[str, Keypoints]:
    stopping = Event()

    def one(name: str) -> Keypoints:
        own = None if masks is None else masks.get(name)
        return camera_keypoints(
            pictures[name], own, config=config, instants=instants, known=known.get(name), stopping=stopping
        )

    with ThreadPoolExecutor(workers) as pool:
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


def _extractor(config: KeypointConfig) -> Any:
    pycolmap = pycolmap_module()
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = 1
    options.use_gpu = False
    options.sift.max_num_features = config.count
    options.sift.peak_threshold = config.peak_threshold
    options.sift.estimate_affine_shape = True
    options.sift.domain_size_pooling = True
    return pycolmap.FeatureExtractor.create(options)


def _extracted(
    extractor: Any, picture: NDArray[np.uint8], mask: NDArray[np.bool_] | None, *, longest_side: int
) -> tuple[Floats, NDArray[np.float32]]:
    """Pixels of the whole picture, and unit descriptors."""
    cv2 = opencv()
    grey = cv2.cvtColor(np.ascontiguousarray(picture), cv2.COLOR_RGB2GRAY)
    height, width = grey.shape
    grey = reduced_picture(grey, longest_side)
    listed, stored = extractor.extract_from_uint8_array(grey)
    places = pycolmap_module().keypoints_to_matrix(listed)[:, :2].astype(np.float64)
    pixels, found = places * (width / grey.shape[1], height / grey.shape[0]), np.asarray(stored.data)
    if mask is not None:
        column, row = np.minimum(pixels, (width - 1, height - 1)).astype(np.intp).T
        inside = mask[row, column]
        pixels, found = pixels[inside], found[inside]
    descriptors = found.astype(np.float32)
    norms = np.linalg.norm(descriptors, axis=1, keepdims=True)
    return pixels, descriptors / np.maximum(norms, 1e-9)


def _repeated(
    pixels: Floats,
    descriptors: NDArray[np.float32],
    found: Floats,
    looks: NDArray[np.float32],
    *,
    config: KeypointConfig,
) -> NDArray[np.intp]:
    """For each of the new keypoints ``found`` the known one that it repeats, or -1."""
    from scipy.spatial import KDTree

    which = np.full(len(found), -1, np.intp)
    if len(pixels) == 0 or len(found) == 0:
        return which
    near = KDTree(pixels).sparse_distance_matrix(KDTree(found), config.same_pixels, output_type="coo_matrix").tocoo()
    alike = np.einsum("sd,sd->s", descriptors[near.row], looks[near.col])
    order = np.argsort(alike, kind="stable")
    order = order[alike[order] > config.same_similarity]
    which[near.col[order]] = near.row[order]  # the last write is the most alike
    return which

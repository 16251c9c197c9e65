# SPDX-License-Identifier: Apache-2.0
"""Keypoints of a still camera over several instants, as one list.

A camera that stands still has one pose at all instants, so its pictures give one set of observations. What stands
still is found again at every instant and counts once; what moves adds keypoints. Each keypoint has a mask of the
instants at which it was seen, because keypoints of two cameras can only be of one point if they share an instant.
"""

from collections.abc import Mapping, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from dataclasses import dataclass
from threading import Event
from typing import Any

import numpy as np
from numpy.typing import NDArray

from structgstream.data.images import opencv, reduced_picture
from structgstream.geometry import Floats
from structgstream.preparation.calibration.colmap import pycolmap_module

MAX_KEYPOINTS = 6000  # of one picture, the largest first
LONGEST_SIDE = 1600  # pixels, to which larger pictures are reduced
PEAK_THRESHOLD = 0.004  # smallest contrast of a keypoint, as a share of the range of the picture
SAME_PIXELS, SAME_SIMILARITY = 1.0, 0.85  # largest distance and smallest cosine of one keypoint at two instants
INSTANTS = 3  # that are looked at before keypoints are counted, and then again
ENOUGH = 6000
"""Keypoints of a camera, in the median over cameras, beyond which no further instants are looked at. Where little has
texture, people who move about add keypoints."""


@dataclass(frozen=True)
class Keypoints:
    """Keypoints of one camera."""

    pixels: Floats  # ``[S, 2]``, the top-left pixel's centre at (0.5, 0.5)
    descriptors: NDArray[np.float32]  # ``[S, 128]`` of unit length (RootSIFT)
    seen: NDArray[np.bool_]  # ``[S, T]``, at which instants

    def __len__(self) -> int:
        return len(self.pixels)


def camera_keypoints(
    pictures: Sequence[NDArray[np.uint8]],
    *,
    instants: Sequence[int] | None = None,
    known: Keypoints | None = None,
    stopping: Event | None = None,
) -> Keypoints:
    """Covariant SIFT keypoints with domain-size pooling of a still camera's ``pictures [H, W, 3]``, merged.

    Affine shapes and pooled descriptors (Mikolajczyk and Schmid, IJCV 2004; Dong and Soatto, CVPR 2015) match over
    wider baselines than plain SIFT.

    Args:
        pictures: of one camera, one an instant.
        instants: which of the pictures are looked at; all by default.
        known: keypoints of the others that were looked at.
        stopping: when it is set, no further picture is looked at.

    Raises:
        CancelledError: ``stopping`` was set.
    """
    extractor = _extractor()
    count = len(pictures)
    found = known or Keypoints(np.empty((0, 2)), np.empty((0, 128), np.float32), np.zeros((0, count), bool))
    for instant in range(count) if instants is None else instants:
        if stopping is not None and stopping.is_set():
            raise CancelledError
        found = _merged(found, instant, *_extracted(extractor, pictures[instant]))
    return found


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


def all_keypoints(pictures: Mapping[str, Sequence[NDArray[np.uint8]]], *, workers: int) -> dict[str, Keypoints]:
    """:func:`camera_keypoints` of every camera, from as many instants as give enough.

    An interruption is noticed between two pictures.
    """
    order = spread_order(min(map(len, pictures.values()), default=0))
    found: dict[str, Keypoints] = {}
    for start in range(0, len(order), INSTANTS):
        found = _with_instants(pictures, found, sorted(order[start : start + INSTANTS]), workers=workers)
        if np.median([len(own) for own in found.values()]) >= ENOUGH:
            break
    return found


def _with_instants(
    pictures: Mapping[str, Sequence[NDArray[np.uint8]]],
    known: Mapping[str, Keypoints],
    instants: Sequence[int],
    *,
    workers: int,
) -> dict[str, Keypoints]:
    stopping = Event()

    def one(name: str) -> Keypoints:
        return camera_keypoints(pictures[name], instants=instants, known=known.get(name), stopping=stopping)

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


def _repeated(known: Keypoints, pixels: Floats, descriptors: NDArray[np.float32]) -> NDArray[np.intp]:
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

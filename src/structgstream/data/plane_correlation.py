# SPDX-License-Identifier: Apache-2.0
"""Zero-mean normalised cross-correlation of a picture with its neighbours seen through a plane (``data.plane_sweep``).

What does not depend on the plane is computed once for a picture (:class:`ReferenceWindow`) and once for each of its
neighbours (:class:`Neighbour`), since a sweep has up to 128 planes.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from structgstream.cameras import Camera
from structgstream.data.arrays import Floats
from structgstream.data.matching import load_cv2

FloatImage = NDArray[np.float32]

# Far below any grey value, so that interpolation with a pixel outside the picture is detectable.
_OUTSIDE = -1e6


@dataclass(frozen=True)
class ReferenceWindow:
    """A grey picture ``[H, W]`` in [0, 1] and its statistics over each pixel's window.

    Args:
        grey: the picture.
        size: side of the window, pixels.
        noise: variance of the noise that is added to variances, so that textureless windows correlate with none.
        mean: ``[H, W]`` means over the windows.
        variance: ``[H, W]`` variances with the noise.
    """

    grey: FloatImage
    size: int
    noise: float
    mean: FloatImage
    variance: FloatImage

    @classmethod
    def of(cls, grey: FloatImage, *, size: int, noise: float) -> "ReferenceWindow":
        """The statistics of ``grey``; ``noise`` is a standard deviation here."""
        mean = _window_means(grey, size)
        variance = _window_means(grey * grey, size) - mean**2 + noise**2
        return cls(grey, size, noise**2, mean, variance)


@dataclass(frozen=True)
class Neighbour:
    """A neighbour's grey picture, and the factors of its homographies from the reference's pixels by any plane."""

    grey: FloatImage
    relative: Floats
    to_ray: Floats
    to_pixel: Floats

    @classmethod
    def of(cls, reference: Camera, camera: Camera, grey: FloatImage) -> "Neighbour":
        """A neighbour with its ``camera`` and picture."""
        relative = camera.viewmat.numpy() @ np.linalg.inv(reference.viewmat.numpy())
        # cv2 puts the first pixel's centre at 0, the cameras at 0.5.
        centred = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])
        to_ray = np.linalg.inv(reference.K.numpy()) @ centred
        return cls(grey, relative, to_ray, np.linalg.inv(centred) @ camera.K.numpy())

    def homography(self, plane: Floats) -> Floats:
        """From the reference's pixel indices to the neighbour's, through ``plane . x = 1`` in the reference's axes."""
        induced = self.relative[:3, :3] + self.relative[:3, 3:] * plane
        return self.to_pixel @ induced @ self.to_ray


def plane_score(window: ReferenceWindow, neighbours: Sequence[Neighbour], plane: Floats) -> FloatImage:
    """Mean correlation ``[H, W]`` of the better half of the neighbours on ``plane``; -0.5 where none sees it."""
    scores = [_correlation(window, neighbour, plane) for neighbour in neighbours]
    best = largest(scores, max(1, (len(scores) + 1) // 2))
    # A view that does not see the plane counts half of the best one: a single match is more likely chance.
    return np.where(best == -1, best.max(0) / 2, best).mean(0, dtype=np.float32)


def largest(images: Sequence[FloatImage], count: int) -> FloatImage:
    """The ``count`` largest values of each pixel among ``images``, ``[count, H, W]`` in no order."""
    if count > 2:
        return np.partition(np.stack(images), len(images) - count, axis=0)[-count:]
    # Minima and maxima of whole images take a tenth of the time of a partition of each pixel.
    first, second = images[0], np.full_like(images[0], -np.inf)
    for image in images[1:]:
        second = np.maximum(second, np.minimum(first, image))
        first = np.maximum(first, image)
    return np.stack([second, first][-count:])


def facing(homography: Floats, height: int, width: int) -> NDArray[np.bool_] | bool:
    """Mask ``[H, W]`` of the pixels that the homography shows in front of the other camera; a bool if all or none."""

    def depth(row: NDArray[np.intp], column: NDArray[np.intp]) -> Floats:
        return homography[2, 0] * column + homography[2, 1] * row + homography[2, 2]

    # Depth is linear, and rounding keeps its order: with all four corners in front, everything is.
    corners = depth(np.array([[0], [height - 1]]), np.array([[0, width - 1]])) > 1e-6
    if corners.all() or not corners.any():
        return bool(corners.all())
    return depth(np.arange(height)[:, None], np.arange(width)[None]) > 1e-6


def _window_means(image: FloatImage, size: int) -> FloatImage:
    cv2 = load_cv2()
    return np.asarray(cv2.boxFilter(image, -1, (size, size), borderType=cv2.BORDER_REFLECT), np.float32)


def _correlation(window: ReferenceWindow, neighbour: Neighbour, plane: Floats) -> FloatImage:
    """Correlation ``[H, W]`` of the reference with a neighbour seen through ``plane . x = 1``, else -1."""
    cv2 = load_cv2()
    height, width = window.grey.shape
    homography = neighbour.homography(plane)
    in_front = facing(homography, height, width)
    if in_front is False:
        return np.full((height, width), -1, np.float32)
    warped = np.asarray(
        cv2.warpPerspective(
            neighbour.grey,
            homography,
            (width, height),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=(_OUTSIDE,),
        ),
        np.float32,
    )
    if in_front is not True:
        warped[~in_front] = _OUTSIDE
    seen = warped >= 0
    # Out of the sums before any is formed: they run in single precision.
    warped[~seen] = 0
    mean = _window_means(warped, window.size)
    covariance = _window_means(window.grey * warped, window.size) - window.mean * mean
    variances = window.variance * (_window_means(warped * warped, window.size) - mean**2 + window.noise)
    score = np.asarray(covariance / np.sqrt(np.maximum(variances, window.noise**2)), np.float32)
    if not seen.all():
        score[cv2.erode(seen.astype(np.uint8), np.ones((window.size, window.size), np.uint8)) == 0] = -1
    return score

# SPDX-License-Identifier: Apache-2.0
"""LDR-FLIP (Andersson et al., 2020): visibility of the difference when a display alternates between two pictures.

Implemented from the paper and tested against its authors' package, ``flip-evaluator`` 1.7, which takes 0.24 s of a core
for a pair of 640x360. Temporal FLIP compares three pairs per frame: rendering with truth, rendering with the previous
rendering, and truth with the previous truth. So features are computed once per picture (:func:`features_of`, 6 ms of a
core) and compared per pair (:func:`flip_of`, 1 ms). Operations are in place where possible, because allocating memory
can cost more than the arithmetic.
"""

from dataclasses import dataclass
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from structgstream.flow import opencv

PIXELS_PER_DEGREE = 0.7 * (3840 / 0.7) * np.pi / 180  # seen from 0.7 m, a display 0.7 m wide with 3840 pixels across

# Contrast sensitivity as sums of Gaussians of the angle x in degrees, a sqrt(pi / b) exp(-pi^2 x^2 / b): pairs (a, b)
# for luminance, red to green and blue to yellow (table 1 of the paper).
SENSITIVITY = (((1.0, 0.0047),), ((1.0, 0.0053),), ((34.1, 0.04), (13.5, 0.025)))
COLOR_EXPONENT, KNEE, KNEE_ERROR = 0.7, 0.4, 0.95  # q_c, p_c, p_t of the paper
# Hunt-adjusted difference of pure green and pure blue, the largest of a display, to the power of COLOR_EXPONENT.
LARGEST_COLOR_DIFFERENCE = 41.2766020417559
FEATURE_DEGREES = 0.082  # width of the detected edges and points
FEATURE_EXPONENT = 0.5

# Linear sRGB to XYZ relative to white, and from there to (Y, X - Y, Y - Z): YCxCz without the scales and offsets of its
# axes, which do not change the result of filters that sum to one.
XYZ = np.array([[0.412391, 0.357584, 0.180481], [0.212639, 0.715169, 0.072192], [0.019331, 0.119195, 0.950532]])
TO_XYZ = XYZ / XYZ.sum(1, keepdims=True)
TO_OPPONENT = np.array([[0.0, 1.0, 0.0], [1.0, -1.0, 0.0], [0.0, 1.0, -1.0]]) @ TO_XYZ
TO_LAB = np.array([[0.0, 116.0, 0.0, -16.0], [500.0, -500.0, 0.0, 0.0], [0.0, 200.0, -200.0, 0.0]])
DELTA = 6 / 29  # below its cube, L*a*b* replaces the cube root by its tangent

Plane = NDArray[np.float32]


@dataclass(frozen=True)
class FlipFeatures:
    """FLIP's features of one picture, each ``[H, W]``."""

    # L*, a* and b* after filtering by contrast sensitivity, a* and b* with Hunt adjustment
    color: tuple[Plane, Plane, Plane]
    edges: Plane  # edge strength at each pixel
    points: Plane  # point and line strength at each pixel


def features_of(picture: NDArray[np.uint8]) -> FlipFeatures:
    """FLIP's features of an 8-bit sRGB picture ``[H, W, 3]`` at the default viewing conditions.

    These are 0.7 m from a display 0.7 m wide with 3840 pixels across, 67.02 pixels a degree.

    Raises:
        MissingExtraError: OpenCV is not installed.
    """
    cv2 = opencv("eval")
    linear = cv2.LUT(np.ascontiguousarray(picture), _linear_levels())
    opponent = cv2.split(cv2.transform(linear, TO_OPPONENT.astype(np.float32)))
    return FlipFeatures(_seen_color(cv2, opponent), *_edges_and_points(cv2, opponent[0]))


def flip_map(one: FlipFeatures, other: FlipFeatures) -> Plane:
    """FLIP of every pixel ``[H, W]``, in [0, 1], of two pictures of the same size; symmetric."""
    cv2 = opencv("eval")
    light, *hues = (cv2.absdiff(a, b) for a, b in zip(one.color, other.color, strict=True))
    light += _length(hues[0], hues[1])
    color = cv2.pow(light, COLOR_EXPONENT, dst=light)
    largest, knee = LARGEST_COLOR_DIFFERENCE, KNEE * LARGEST_COLOR_DIFFERENCE
    # Both lines pass through the knee, and the second is less steep.
    above = (1 - KNEE_ERROR) / (largest - knee)
    second = color * np.float32(above)
    second += np.float32(1 - above * largest)
    color *= np.float32(KNEE_ERROR / knee)
    error = np.clip(cv2.min(color, second, dst=color), 0.0, 1.0, out=color)
    points = cv2.absdiff(one.points, other.points, dst=second)
    feature = cv2.max(cv2.absdiff(one.edges, other.edges), points, dst=points)
    feature *= np.float32(0.5**0.5)  # the two axes' strengths are at most 1 each
    np.minimum(cv2.pow(feature, FEATURE_EXPONENT, dst=feature), 1.0, out=feature)
    return np.power(error, np.subtract(1.0, feature, out=feature), out=error)


def flip_of(one: FlipFeatures, other: FlipFeatures, *, mask: NDArray[np.bool_] | None = None) -> float:
    """Mean of :func:`flip_map` over the pixels of ``mask`` ``[H, W]``, or all; 0 for equal pictures, 1 at most."""
    found = flip_map(one, other)
    return float((found if mask is None else found[mask]).mean(dtype=np.float64))


def _linear_levels() -> NDArray[np.float32]:
    """Linear light ``[256]`` of each level of sRGB."""
    level = np.arange(256) / 255
    return np.where(level <= 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4).astype(np.float32)


def _bell(deviation: float, radius: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Offsets ``[2 radius + 1]`` in pixels, and a Gaussian there that is not normalised."""
    x = np.arange(-radius, radius + 1.0)
    return x, np.exp(-(x**2) / (2 * deviation**2))


def _seen_color(cv2: ModuleType, opponent: tuple[Plane, ...]) -> tuple[Plane, Plane, Plane]:
    deviations = [[PIXELS_PER_DEGREE * (b / 2) ** 0.5 / np.pi for _, b in terms] for terms in SENSITIVITY]
    radius = int(np.ceil(3 * max(max(of_one) for of_one in deviations)))  # one for all three filters
    blurred = []
    for plane, terms, widths in zip(opponent, SENSITIVITY, deviations, strict=True):
        # The Gaussian beyond five deviations is below the rounding of float32.
        bells = [_bell(deviation, min(radius, int(np.ceil(5 * deviation))))[1] for deviation in widths]
        weights = [a * (np.pi / b) ** 0.5 * bell.sum() ** 2 for (a, b), bell in zip(terms, bells, strict=True)]
        total = np.zeros_like(plane)
        for bell, weight in zip(bells, weights, strict=True):
            kernel = (bell / bell.sum()).astype(np.float32)
            smooth = cv2.sepFilter2D(plane, -1, kernel, kernel, borderType=cv2.BORDER_REPLICATE)
            cv2.scaleAdd(smooth, weight / sum(weights), total, dst=total)
        blurred.append(total)
    linear = cv2.transform(cv2.merge(blurred), np.linalg.inv(TO_OPPONENT).astype(np.float32))
    light, red, yellow = cv2.split(_lab(cv2, np.clip(linear, 0.0, 1.0, out=linear)))
    for hue in (red, yellow):
        cv2.multiply(hue, light, dst=hue, scale=0.01)
    return light, red, yellow


def _lab(cv2: ModuleType, linear: NDArray[np.float32]) -> NDArray[np.float32]:
    """L*a*b* of linear sRGB in [0, 1], both ``[..., 3]``; overwrites its argument."""
    xyz = cv2.transform(linear, TO_XYZ.astype(np.float32))
    # The root's argument is bounded from below, and the tangent adds the difference: no precision is lost near black.
    knee = np.float32(DELTA**3)
    root = np.maximum(xyz, knee, out=linear)
    cv2.pow(root, 1 / 3, dst=root)
    np.minimum(xyz, knee, out=xyz)
    xyz -= knee
    cv2.scaleAdd(xyz, 1 / (3 * DELTA**2), root, dst=root)
    return cv2.transform(root, TO_LAB.astype(np.float32), dst=xyz)


def _edges_and_points(cv2: ModuleType, luminance: Plane) -> tuple[Plane, Plane]:
    """Lengths of the first and second derivatives of luminance, along x and y."""
    deviation = 0.5 * FEATURE_DEGREES * PIXELS_PER_DEGREE
    x, bell = _bell(deviation, int(np.ceil(3 * deviation)))
    found = []
    for kernel in (-x * bell, ((x / deviation) ** 2 - 1) * bell):
        # Positive weights sum to 1 and negative ones to -1; in the other direction the Gaussian sums to 1.
        along = np.where(kernel > 0, kernel / kernel[kernel > 0].sum(), kernel / -kernel[kernel < 0].sum())
        pair = along.astype(np.float32), (bell / bell.sum()).astype(np.float32)
        x_and_y = (pair, pair[::-1])
        slopes = [cv2.sepFilter2D(luminance, -1, *order, borderType=cv2.BORDER_REPLICATE) for order in x_and_y]
        found.append(_length(slopes[0], slopes[1]))
    return found[0], found[1]


def _length(x: Plane, y: Plane) -> Plane:
    """Length of the vectors ``(x, y)``; overwrites both. OpenCV's own function rounds depending on memory alignment."""
    x *= x
    y *= y
    x += y
    return np.sqrt(x, out=x)

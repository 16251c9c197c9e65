# SPDX-License-Identifier: Apache-2.0
"""Lens distortion models.

Points are in normalised coordinates, on the plane one unit in front of the camera, ``[..., 2]`` float64. Each lens has

- ``reach``: radius, in normalised coordinates, up to which the model is invertible;
- ``distort``: from undistorted to distorted points; NaN beyond the reach;
- ``undistort``: the inverse; NaN outside the image of the reach.

Intrinsics follow the package's convention, the top-left pixel's centre at (0.5, 0.5); :func:`from_integer_centers`
converts those of tools that have it at (0, 0), such as OpenCV.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import ArrayLike

from structgstream.cameras import Camera
from structgstream.data.text_files import Unreadable, number
from structgstream.geometry import Floats

NEWTON_STEPS = 50
CLOSE_ENOUGH = 1e-10
FAR = 12.0  # normalised: 85 degrees from the axis


@dataclass(frozen=True)
class Pinhole:
    """No distortion."""

    @property
    def reach(self) -> float:
        return math.inf

    def distort(self, points: Floats) -> Floats:
        return points

    def undistort(self, points: Floats) -> Floats:
        return points


@dataclass(frozen=True)
class RadialTangential:
    """OpenCV's model: radial factor ``(1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)`` and tangential
    distortion ``p1``, ``p2`` (Brown, Decentering Distortion of Lenses, 1966)."""

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0

    @cached_property
    def reach(self) -> float:
        """The smallest radius at which the distorted picture folds, or the factor has a pole."""
        over, under = self._polynomials
        radius = Polynomial([0.0, 1.0])
        grows = (radius * over).deriv() * under - radius * over * under.deriv()
        radial = min(_first_root(grows), _first_root(under)) * (1 - 1e-9)
        if not (self.p1 or self.p2):
            return radial
        radii, angles = np.linspace(0, min(radial, FAR), 256), np.linspace(0, 2 * math.pi, 64, endpoint=False)
        rays = np.stack([np.cos(angles), np.sin(angles)], -1)
        folded = np.linalg.det(_jacobian(self._anywhere, radii[:-1, None, None] * rays)).min(1) <= 0
        return float(radii[:-1][folded][0]) if folded.any() else radial

    @cached_property
    def _polynomials(self) -> tuple[Polynomial, Polynomial]:
        """Numerator and denominator of the factor, in the radius."""
        over = Polynomial([1.0, 0.0, self.k1, 0.0, self.k2, 0.0, self.k3])
        return over, Polynomial([1.0, 0.0, self.k4, 0.0, self.k5, 0.0, self.k6])

    def distort(self, points: Floats) -> Floats:
        return np.where(_radii(points) <= self.reach, self._anywhere(points), np.nan)

    def _anywhere(self, points: Floats) -> Floats:
        over, under = self._polynomials
        radii = _radii(points)
        x, y = points[..., :1], points[..., 1:]
        tilt = 2 * x * y * [self.p1, self.p2]
        tilt = tilt + np.array([self.p2, self.p1]) * (radii**2 + 2 * points**2)
        return points * (over(radii) / under(radii)) + tilt

    def undistort(self, points: Floats) -> Floats:
        """Newton's method, started from the inverse of the radial part."""
        wanted, points = points, np.nan_to_num(points)
        radii, reach = _radii(points), self.reach
        over, under = self._polynomials
        bounded = _inverse(lambda r: r * over(r) / under(r), radii, most=reach)
        tilted = bool(self.p1 or self.p2)
        start = np.where(np.isfinite(bounded) | (not tilted), bounded, min(reach, FAR))
        found = points * np.where(radii > 0, start / np.where(radii > 0, radii, 1.0), 1.0)
        if not tilted:
            return np.where(np.isnan(wanted), np.nan, found)
        for _ in range(NEWTON_STEPS):
            jacobian = _jacobian(self._anywhere, found)
            flat = np.abs(np.linalg.det(jacobian)) < 1e-9
            step = np.linalg.solve(np.where(flat[..., None, None], np.eye(2), jacobian), self._missed(found, points))
            found = found - step[..., 0]
            found = found * np.minimum(1, reach / np.maximum(_radii(found), 1e-12))
            if np.abs(step).max(initial=0.0) < CLOSE_ENOUGH:
                break
        close = np.abs(self._missed(found, points)[..., 0]).max(-1, keepdims=True) < 1e-6
        return np.where(close & np.isfinite(wanted), found, np.nan)

    def _missed(self, found: Floats, points: Floats) -> Floats:
        return (self._anywhere(found) - points)[..., None]


@dataclass(frozen=True)
class Fisheye:
    """OpenCV's equidistant model: a ray at angle ``t`` to the axis has the distorted radius
    ``t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8)`` (Kannala and Brandt, 2006)."""

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0

    @cached_property
    def widest_angle(self) -> float:
        """The angle to the axis, radians, up to which the model is invertible; at most a right angle."""
        grows = self._radius.deriv()
        return min(_first_root(grows), math.pi / 2 - 1e-6)

    @cached_property
    def _radius(self) -> Polynomial:
        return Polynomial([0.0, 1.0, 0.0, self.k1, 0.0, self.k2, 0.0, self.k3, 0.0, self.k4])

    @property
    def reach(self) -> float:
        return math.tan(self.widest_angle)

    def distort(self, points: Floats) -> Floats:
        radii = _radii(points)
        angles = np.arctan(radii)
        factor = np.where(radii > 1e-12, self._radius(angles) / np.maximum(radii, 1e-12), 1.0)
        return np.where(angles <= self.widest_angle, points * factor, np.nan)

    def undistort(self, points: Floats) -> Floats:
        radii = _radii(points)
        angles = _inverse(self._radius, radii, most=self.widest_angle)
        return points * np.where(radii > 1e-12, np.tan(angles) / np.maximum(radii, 1e-12), 1.0)


Lens = Pinhole | RadialTangential | Fisheye


@dataclass(frozen=True)
class LensCamera:
    """A camera with distortion: ``camera`` holds intrinsics, pose and picture size, ``lens`` the distortion."""

    camera: Camera
    lens: Lens

    def pixels(self, points: Floats) -> Floats:
        """Pixels of world points ``[..., 3]``; NaN beyond the reach of the lens and behind the camera."""
        viewmat = self.camera.viewmat.numpy()
        local = points @ viewmat[:3, :3].T + viewmat[:3, 3]
        depths = np.where(local[..., 2:] > 0, local[..., 2:], np.nan)
        return self.to_pixels(local[..., :2] / depths)

    def to_pixels(self, normalised: Floats) -> Floats:
        """Distorted pixels ``[..., 2]`` of normalised points."""
        K = self.camera.K.numpy()
        return self.lens.distort(normalised) @ K[:2, :2].T + K[:2, 2]

    def to_normalized(self, pixels: Floats) -> Floats:
        """Undistorted normalised points ``[..., 2]`` of pixels."""
        K = self.camera.K.numpy()
        return self.lens.undistort((pixels - K[:2, 2]) @ np.linalg.inv(K[:2, :2]).T)


def from_integer_centers(K: ArrayLike) -> Floats:
    """Converts intrinsics ``[3, 3]`` with the top-left pixel's centre at (0, 0) to the package's convention."""
    moved = np.array(K, dtype=np.float64)
    moved[:2, 2] += 0.5
    return moved


def opencv_lens(coefficients: Sequence[float]) -> Lens:
    """From OpenCV's vector ``k1, k2, p1, p2[, k3[, k4, k5, k6]]``, which may be empty, or longer by zeros."""
    values = [number(value) for value in coefficients]
    if any(values[8:]) or len(values) in (1, 2, 3):
        raise Unreadable(
            f"{len(values)} distortion coefficients; expected 4, 5 or 8 (k1, k2, p1, p2, k3, k4, k5, k6): calibrate "
            "again without thin prism and tilted sensor"
        )
    return RadialTangential(*values[:8]) if any(values) else Pinhole()


def fisheye_lens(coefficients: Sequence[float]) -> Fisheye:
    """From the vector ``k1, k2, k3, k4`` of OpenCV's fisheye module; missing ones are 0."""
    values = [number(value) for value in coefficients]
    if any(values[4:]):
        raise Unreadable(f"{len(values)} fisheye coefficients; expected at most 4 (k1, k2, k3, k4)")
    return Fisheye(*values[: len(fields(Fisheye))])


def _radii(points: Floats) -> Floats:
    return np.linalg.norm(points, axis=-1, keepdims=True)


def _first_root(polynomial: Polynomial) -> float:
    """The smallest positive real root, infinity without one."""
    roots = polynomial.trim().roots()
    real = roots[np.abs(roots.imag) < 1e-9].real
    return float(min(real[real > 1e-9], default=math.inf))


def _inverse(grows: Callable[[Floats], Floats], values: Floats, *, most: float) -> Floats:
    """Inverse, by bisection, of a function that increases on [0, ``most``]; NaN for values outside its range."""
    low, high = np.zeros_like(values), np.full_like(values, most)
    if math.isinf(most):
        high = np.maximum(values, 1.0)
        while (short := grows(high) < values).any():
            high = np.where(short, 2 * high, high)
    inside = values <= grows(high)
    for _ in range(70):
        middle = (low + high) / 2
        below = grows(middle) < values
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return np.where(inside, high, np.nan)


def _jacobian(function: Callable[[Floats], Floats], points: Floats) -> Floats:
    """Derivatives ``[..., 2, 2]`` by central differences: exact enough for Newton's steps."""
    step = 1e-6
    columns = [(function(points + axis) - function(points - axis)) / (2 * step) for axis in np.eye(2) * step]
    return np.stack(columns, axis=-1)

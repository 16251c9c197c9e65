# SPDX-License-Identifier: Apache-2.0
"""Intrinsics and lenses as rows of numbers, for adjustments that COLMAP's models cannot express, and their prior.

A row holds the logarithm of the focal length, the logarithm of the ratio of the vertical to the horizontal one, the
principal point's offset from the picture's centre and eight terms of distortion, in the order of the fields of
:class:`~structgstream.data.lenses.RadialTangential` or :class:`~structgstream.data.lenses.Fisheye`. Lengths are shares
of the picture's longer side, so that rows of pictures of different sizes can be compared.

Note [Alike lenses]
~~~~~~~~~~~~~~~~~~~
Cameras around a scene hardly distinguish a principal point from a rotation, nor k1 from a focal length. Left free, such
terms wander off; held at zero, they are wrong, since the principal points of one make of camera lie off the centre by
the same few pixels. So a term of the lenses of one group (pictures of one size) is normal about a mean that the group
shares. The mean and how far lenses differ from it are estimated, by expectation maximisation (Dempster et al., 1977):
where the pictures distinguish lenses they differ, and where they do not they are pooled."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass, replace
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray

from structgstream.data.lenses import Fisheye, Lens, LensCamera, Pinhole, RadialTangential
from structgstream.geometry import Floats, Indices

LensModel = Literal["pinhole", "radial", "opencv", "brown", "fisheye"]
"""What is estimated of a lens: nothing; k1, k2; k1, k2, p1, p2; the same and k3; k1 to k4 of a fisheye."""
FOCAL, ASPECT, ACROSS, DOWN = range(4)
K1, K2, P1, P2, K3 = range(4, 9)
TERMS = 12
DISTORTION: Mapping[LensModel, tuple[int, ...]] = {
    "pinhole": (),
    "radial": (K1, K2),
    "opencv": (K1, K2, P1, P2),
    "brown": (K1, K2, P1, P2, K3),
    "fisheye": (4, 5, 6, 7),
}
"""The terms of distortion that each model has."""


def row_of(filmed: LensCamera) -> Floats:
    """``[TERMS]`` of a camera."""
    own = filmed.camera
    K, longest = own.K.numpy(), max(own.width, own.height)
    lens = [float(value) for value in astuple(filmed.lens)]
    center = (K[0, 2] - own.width / 2) / longest, (K[1, 2] - own.height / 2) / longest
    head = [math.log(K[0, 0] / longest), math.log(K[1, 1] / K[0, 0]), *center]
    return np.array([*head, *lens, *[0.0] * (TERMS - 4 - len(lens))])


def with_row(filmed: LensCamera, row: Floats, viewmat: Floats) -> LensCamera:
    """A camera of the same size and kind of lens with other intrinsics and another pose."""
    own = filmed.camera
    longest = max(own.width, own.height)
    focal = math.exp(row[FOCAL]) * longest
    across, down = own.width / 2 + row[ACROSS] * longest, own.height / 2 + row[DOWN] * longest
    K = torch.tensor([[focal, 0, across], [0, focal * math.exp(row[ASPECT]), down], [0, 0, 1]], dtype=torch.float64)
    terms = [float(value) for value in row[4:]]
    lens: Lens = Pinhole()
    if isinstance(filmed.lens, Fisheye):
        lens = Fisheye(*terms[:4])
    elif any(terms):
        lens = RadialTangential(*terms)
    return LensCamera(replace(own, viewmat=torch.from_numpy(viewmat), K=K), lens)


def projected(local: Floats, rows: Floats, sizes: Floats, fisheye: NDArray[np.bool_]) -> Floats:
    """Pixels ``[M, 2]`` of points ``[M, 3]`` in the axes of their cameras."""
    bent, _, _ = _bent(local, rows, fisheye)
    return _focal(rows, sizes) * bent + sizes / 2 + rows[:, [ACROSS, DOWN]] * sizes.max(1, keepdims=True)


def derivatives(
    local: Floats, rows: Floats, sizes: Floats, fisheye: NDArray[np.bool_], free: Sequence[int]
) -> tuple[Floats, Floats]:
    """Of :func:`projected` by the points ``[M, 2, 3]`` and by the free terms of the rows ``[M, 2, len(free)]``."""
    bent, by_flat, by_terms = _bent(local, rows, fisheye)
    focal, longest = _focal(rows, sizes)[:, :, None], sizes.max(1)
    by_local = np.zeros((len(local), 2, 3))
    by_local[:, 0, 0] = by_local[:, 1, 1] = 1 / local[:, 2]
    by_local[:, :, 2] = -local[:, :2] / local[:, 2:] ** 2
    by_row = np.zeros((len(local), 2, TERMS))
    by_row[:, :, FOCAL] = focal[:, :, 0] * bent
    by_row[:, 1, ASPECT] = focal[:, 1, 0] * bent[:, 1]
    by_row[:, 0, ACROSS] = by_row[:, 1, DOWN] = longest
    by_row[:, :, 4:] = focal * by_terms
    return focal * (by_flat @ by_local), by_row[:, :, list(free)]


def _focal(rows: Floats, sizes: Floats) -> Floats:
    """Focal lengths ``[M, 2]`` in pixels."""
    across = np.exp(rows[:, FOCAL]) * sizes.max(1)
    return np.stack([across, across * np.exp(rows[:, ASPECT])], 1)


def _bent(local: Floats, rows: Floats, fisheye: NDArray[np.bool_]) -> tuple[Floats, Floats, Floats]:
    """Distorted points ``[M, 2]`` and their derivatives by the undistorted ones and by the eight terms."""
    flat = local[:, :2] / local[:, 2:]
    if not fisheye.any():
        return _brown(flat, rows[:, 4:])
    if fisheye.all():
        return _equidistant(flat, rows[:, 4:])
    both = zip(_brown(flat, rows[:, 4:]), _equidistant(flat, rows[:, 4:]), strict=True)
    bent, by_flat, by_terms = (np.where(fisheye.reshape(-1, *[1] * (a.ndim - 1)), b, a) for a, b in both)
    return bent, by_flat, by_terms


def _brown(flat: Floats, terms: Floats) -> tuple[Floats, Floats, Floats]:
    k1, k2, p1, p2, k3, k4, k5, k6 = terms.T
    x, y = flat.T
    squared = x**2 + y**2
    powers = squared[:, None] ** np.arange(1, 4)
    over = 1 + (powers * np.stack([k1, k2, k3], 1)).sum(1)
    under = 1 + (powers * np.stack([k4, k5, k6], 1)).sum(1)
    over_grows = k1 + squared * (2 * k2 + 3 * squared * k3)
    under_grows = k4 + squared * (2 * k5 + 3 * squared * k6)
    factor, grows = over / under, (over_grows * under - over * under_grows) / under**2
    tilt = np.stack([2 * p1 * x * y + p2 * (squared + 2 * x**2), 2 * p2 * x * y + p1 * (squared + 2 * y**2)], 1)
    by_flat = _radial(flat, factor, 2 * grows)
    by_flat[:, 0, 0] += 2 * p1 * y + 6 * p2 * x
    by_flat[:, 1, 1] += 2 * p2 * x + 6 * p1 * y
    by_flat[:, [0, 1], [1, 0]] += 2 * (p1 * x + p2 * y)[:, None]
    by_terms = np.empty((len(flat), 2, 8))
    by_terms[:, :, [0, 1, 4]] = flat[:, :, None] * (powers / under[:, None])[:, None]
    by_terms[:, :, 5:] = -flat[:, :, None] * (powers * (over / under**2)[:, None])[:, None]
    by_terms[:, :, 2] = np.stack([2 * x * y, squared + 2 * y**2], 1)
    by_terms[:, :, 3] = np.stack([squared + 2 * x**2, 2 * x * y], 1)
    return flat * factor[:, None] + tilt, by_flat, by_terms


def _equidistant(flat: Floats, terms: Floats) -> tuple[Floats, Floats, Floats]:
    radius = np.maximum(np.linalg.norm(flat, axis=1), 1e-9)
    angle = np.arctan(radius)
    powers = angle[:, None] ** np.array([3, 5, 7, 9])
    bent = angle + (powers * terms[:, :4]).sum(1)
    by_angle = 1 + (powers / angle[:, None] * terms[:, :4] * [3, 5, 7, 9]).sum(1)
    factor = bent / radius
    grows = np.where(radius > 1e-6, (by_angle / (1 + radius**2) - factor) / radius**2, 0.0)
    by_terms = np.zeros((len(flat), 2, 8))
    by_terms[:, :, :4] = flat[:, :, None] * (powers / radius[:, None])[:, None]
    return flat * factor[:, None], _radial(flat, factor, grows), by_terms


def _radial(flat: Floats, factor: Floats, grows: Floats) -> Floats:
    """Derivative ``[M, 2, 2]`` of ``flat * factor``, where the factor's is ``flat * grows``."""
    return factor[:, None, None] * np.eye(2) + grows[:, None, None] * flat[:, :, None] * flat[:, None]


# Shares of the longer side, and terms of normalised coordinates: how far the mean of a make lies from zero, and how
# far cameras of it usually are from that. Estimation starts there.
USUAL: Mapping[int, tuple[float, float]] = {
    ASPECT: (0.005, 0.0005),
    ACROSS: (0.01, 0.002),
    DOWN: (0.01, 0.002),
    K1: (0.3, 0.005),
    K2: (1.0, 0.01),
    P1: (0.002, 0.0003),
    P2: (0.002, 0.0003),
    K3: (1.0, 0.02),
}
USUAL_FISHEYE: Mapping[int, tuple[float, float]] = {
    **{term: USUAL[term] for term in (ASPECT, ACROSS, DOWN)},
    4: (0.2, 0.005),
    **dict.fromkeys((5, 6, 7), (0.1, 0.005)),
}
WORTH = 2.0  # lenses that the usual differences count as, in addition to those of the rig
MIN_DIFFERENCE = 0.01  # of the usual differences


@dataclass(frozen=True)
class LensPrior:
    """A normal prior of terms of lenses about means that groups share."""

    group: Indices  # ``[L]``, of each lens
    terms: tuple[int, ...]  # which terms of the rows have one
    means: Floats  # ``[G, T]``, standard deviations of the means
    differences: Floats  # ``[G, T]``, of lenses of a group from its mean
    usual: Floats  # ``[T]``, of ``differences`` before any were estimated

    def cost(self, rows: Floats) -> float:
        """Minus the logarithm of the density, but for a constant."""
        found = ((rows[lenses, term], precision) for lenses, term, precision in self._precisions())
        return sum(float(own @ precision @ own) / 2 for own, precision in found)

    def add(self, A: Floats, gradient: Floats, rows: Floats, *, start: int, free: Sequence[int]) -> None:
        """Adds it to normal equations in which the free terms of the lenses come, row by row, from ``start`` on."""
        for lenses, term, precision in self._precisions():
            where = start + lenses * len(free) + free.index(term)
            A[np.ix_(where, where)] += precision
            gradient[where] += precision @ rows[lenses, term]

    def updated(self, rows: Floats, covariance: Floats, *, start: int, free: Sequence[int]) -> "LensPrior":
        """With the deviations that rows and their covariance, in the order of :meth:`add`, make most likely."""
        differences, means = self.differences.copy(), self.means.copy()
        for group, column in np.ndindex(differences.shape):
            lenses, term = np.flatnonzero(self.group == group), self.terms[column]
            where = start + lenses * len(free) + free.index(term)
            pull = self._pull(group, column)
            own = covariance[np.ix_(where, where)]
            centering = np.eye(len(lenses)) - pull
            spread = np.einsum("ij,jk,ik->i", centering, own, centering)
            unsure = self.differences[group, column] ** 2 * pull  # of the mean, were the lenses known
            squared = (centering @ rows[lenses, term]) ** 2 + np.maximum(spread, 0) + unsure
            usual = self.usual[column]
            found = (WORTH * usual**2 + squared.sum()) / (WORTH + len(lenses))
            differences[group, column] = max(np.sqrt(found), MIN_DIFFERENCE * usual)
            mean = (pull * rows[lenses, term].sum()) ** 2 + pull**2 * max(own.sum(), 0.0) + unsure
            means[group, column] = max(np.sqrt(mean), MIN_DIFFERENCE * usual)
        return replace(self, means=means, differences=differences)

    def _pull(self, group: int, column: int) -> float:
        """How much one lens moves the mean of its group."""
        mean, own = self.means[group, column] ** 2, self.differences[group, column] ** 2
        return mean / (own + mean * int((self.group == group).sum()))

    def _precisions(self) -> Iterator[tuple[Indices, int, Floats]]:
        """Of each group and term: the lenses, and the inverse of their covariance once the mean is integrated out."""
        for group, column in np.ndindex(self.differences.shape):
            lenses = np.flatnonzero(self.group == group)
            inverse = (np.eye(len(lenses)) - self._pull(group, column)) / self.differences[group, column] ** 2
            yield lenses, self.terms[column], inverse


def usual_prior(group: Indices, free: Sequence[int], *, fisheye: bool) -> LensPrior:
    """The prior before any picture is looked at, of the free terms that have one."""
    usual = USUAL_FISHEYE if fisheye else USUAL
    terms = tuple(term for term in free if term in usual)
    means, differences = (np.array([usual[term][which] for term in terms]) for which in range(2))
    groups = int(group.max(initial=-1)) + 1
    return LensPrior(group, terms, np.tile(means, (groups, 1)), np.tile(differences, (groups, 1)), differences)

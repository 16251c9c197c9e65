# SPDX-License-Identifier: Apache-2.0
"""What is known of lenses before any picture is looked at: those of one make are alike.

Note [Alike lenses]: cameras around a scene hardly distinguish a principal point from a rotation, nor k1 from a focal
length. Left free, such terms wander off; held at zero, they are wrong, since the principal points of one make of camera
lie off the centre by the same few pixels. So a term of the lenses of one group (pictures of one size) is normal about a
mean that the group shares, and that is itself estimated. How far lenses differ is estimated, too, by expectation
maximisation (Dempster et al., 1977): where the pictures distinguish lenses they differ, and where they do not they are
pooled.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from structgstream.data.arrays import Floats
from structgstream.preparation.calibration.lens_terms import ACROSS, ASPECT, DOWN, K1, K2, K3, P1, P2

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
    ASPECT: (0.005, 0.0005),
    ACROSS: (0.01, 0.002),
    DOWN: (0.01, 0.002),
    4: (0.2, 0.005),
    5: (0.1, 0.005),
    6: (0.1, 0.005),
    7: (0.1, 0.005),
}
WORTH = 2.0  # lenses that the usual differences count as, in addition to those of the rig
MIN_DIFFERENCE = 0.01  # of the usual differences


@dataclass(frozen=True)
class LensPrior:
    """A normal prior of terms of lenses about means that groups share.

    Args:
        group: ``[L]``, of each lens.
        terms: which terms of the rows have one.
        means: ``[G, T]``, standard deviations of the means.
        differences: ``[G, T]``, of lenses of a group from its mean.
        usual: ``[T]``, of ``differences`` before any were estimated.
    """

    group: NDArray[np.intp]
    terms: tuple[int, ...]
    means: Floats
    differences: Floats
    usual: Floats

    def cost(self, rows: Floats) -> float:
        """Minus the logarithm of the density, but for a constant."""
        return sum(
            float(rows[lenses, term] @ precision @ rows[lenses, term]) / 2
            for lenses, term, precision in self._precisions()
        )

    def add(self, A: Floats, gradient: Floats, rows: Floats, *, start: int, free: Sequence[int]) -> None:
        """Adds it to normal equations in which the free terms of the lenses come, row by row, from ``start`` on."""
        for lenses, term, precision in self._precisions():
            where = start + lenses * len(free) + free.index(term)
            A[np.ix_(where, where)] += precision
            gradient[where] += precision @ rows[lenses, term]

    def shared(self, rows: Floats) -> Floats:
        """The estimated means ``[G, T]``."""
        found = np.zeros_like(self.differences)
        for group, column in np.ndindex(found.shape):
            own = rows[self.group == group, self.terms[column]]
            found[group, column] = self._pull(group, column) * own.sum()
        return found

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

    def _precisions(self) -> list[tuple[NDArray[np.intp], int, Floats]]:
        """Of each group and term: the lenses, and the inverse of their covariance once the mean is integrated out."""
        found = []
        for group, column in np.ndindex(self.differences.shape):
            lenses = np.flatnonzero(self.group == group)
            inverse = (np.eye(len(lenses)) - self._pull(group, column)) / self.differences[group, column] ** 2
            found.append((lenses, self.terms[column], inverse))
        return found


def usual_prior(group: NDArray[np.intp], free: Sequence[int], *, fisheye: bool) -> LensPrior:
    """The prior before any picture is looked at, of the free terms that have one."""
    usual = USUAL_FISHEYE if fisheye else USUAL
    terms = tuple(term for term in free if term in usual)
    means, differences = (np.array([usual[term][which] for term in terms]) for which in range(2))
    groups = int(group.max(initial=-1)) + 1
    return LensPrior(group, terms, np.tile(means, (groups, 1)), np.tile(differences, (groups, 1)), differences)

# SPDX-License-Identifier: Apache-2.0
"""The least-squares problem of tone curves, for one channel.

Note [Common tone]
~~~~~~~~~~~~~~~~~~
Radiometric calibration from correspondences, as in Kim and Pollefeys (Robust radiometric calibration and vignetting
correction, PAMI 2008), but towards a common rendering rather than towards light: with the curve ``f`` of a camera and
the value ``x`` that it has of a point, ``f(x)`` shall be the same for all cameras that see the point. This is linear in
the controls of the curves. The mean of the cameras' curves is the identity, as that of a scene's camera colours is: if
one camera were fixed instead, all others would agree better by losing contrast.

Points that shine, or that a camera sees wrongly, agree under no curve: residuals are weighted by Cauchy's function with
a scale from their median. Curvature and departure from the identity have wide priors, for tones that no point has.
"""

import numpy as np
from numpy.typing import NDArray

from structgstream.data.arrays import Floats
from structgstream.data.tone import IDENTITY, basis

Indices = NDArray[np.int64]

ROUNDS = 20
CONVERGED = 1e-4
CURVATURE, DEPARTURE = 2.0, 0.5
"""Prior standard deviations of a curve's second derivative and of its distance from the identity."""
LEAST_SLOPE = 0.1
CAUCHY = 2.385
"""Of the scale: 95 % efficient for normal residuals (Holland and Welsch, 1977)."""
LEAST_SCALE = 0.5 / 255
GAUGE = 1e4
"""Weight of the mean curve over that of the pictures."""


def gain_and_bias() -> Floats:
    """``[8, 2]``: the controls of a bias and of a gain."""
    return np.stack([np.ones_like(IDENTITY), IDENTITY], 1)


def slopes() -> Floats:
    """``[8, 8]``: the controls of a bias and of a slope for each step between controls."""
    steps = np.diff(IDENTITY, prepend=0.0)
    return np.column_stack([np.ones_like(IDENTITY), np.tril(np.repeat(steps[None], len(IDENTITY), 0))[:, 1:]])


def common_curves(point: Indices, camera: Indices, values: Floats, *, free: Floats) -> Floats:
    """The controls ``[C, 8]`` under which the cameras agree.

    Args:
        point: ``[M]`` which point of the scene a sample is of, from 0.
        camera: ``[M]`` which camera has it, from 0; each has some.
        values: ``[M]``, 0 to 1.
        free: :func:`slopes`, or :func:`gain_and_bias` for curves that are straight.
    """
    from scipy.sparse import csr_matrix, diags

    count, size = int(camera.max()) + 1, free.shape[1]
    rows = basis(values) @ free
    columns = camera[:, None] * size + np.arange(size)
    design = csr_matrix((rows.ravel(), columns.ravel(), np.arange(0, rows.size + 1, size)), (len(rows), count * size))
    of_point = csr_matrix((np.ones(len(point)), (point, np.arange(len(point)))))
    theta = np.tile(_straight(free), (count, 1))
    for _ in range(ROUNDS):
        mapped = (rows * theta[camera]).sum(1)
        weights, scale = np.ones(len(point)), None
        for _ in range(2):  # the mean of a point by the weights of its residuals
            mean = (of_point @ (weights * mapped)) / (of_point @ weights)
            weights, scale = _weights(mapped - mean[point])
        assert scale is not None
        weighted = diags(weights) @ design
        sums = of_point @ weighted
        normal = (design.T @ weighted - sums.T @ diags(1 / (of_point @ weights)) @ sums).toarray() / scale**2
        before = theta
        theta = _solved(normal, np.zeros(len(normal)), free, count=count)
        if np.abs(theta - before).max() < CONVERGED:
            break
    return theta @ free.T


def curve_towards(values: Floats, targets: Floats, *, free: Floats) -> Floats:
    """The controls ``[8]`` of one camera's curve from its ``values [M]`` to ``targets [M]``."""
    rows = basis(values) @ free
    theta = _straight(free)
    for _ in range(ROUNDS):
        weights, scale = _weights(rows @ theta - targets)
        weighted = rows * (weights / scale**2)[:, None]
        before = theta
        theta = _solved(weighted.T @ rows, weighted.T @ targets, free, count=1, gauged=False)[0]
        if np.abs(theta - before).max() < CONVERGED:
            break
    return free @ theta


def _straight(free: Floats) -> Floats:
    """The parameters ``[F]`` of the identity: no bias, slopes of one."""
    return np.array([0.0, *[1.0] * (free.shape[1] - 1)])


def _weights(residuals: Floats) -> tuple[Floats, float]:
    """Cauchy's weights ``[M]``, and the residuals' standard deviation without outliers."""
    scale = max(1.4826 * float(np.median(np.abs(residuals))), LEAST_SCALE)
    return 1 / (1 + (residuals / (CAUCHY * scale)) ** 2), scale


def _solved(normal: Floats, right: Floats, free: Floats, *, count: int, gauged: bool = True) -> Floats:
    """The parameters ``[C, F]`` with the least squared error, by normal equations, among curves that rise."""
    from scipy.optimize import lsq_linear

    size = free.shape[1]
    prior, pull = _prior(free)
    normal = normal + np.kron(np.eye(count), prior)
    right = right + np.tile(pull, count)
    if gauged:
        weight = GAUGE * float(np.diag(normal).mean()) / count
        normal = normal + weight * np.kron(np.ones((count, count)), np.eye(size))
        right = right + weight * count * np.tile(_straight(free), count)
    found = np.linalg.solve(normal, right)
    least = np.tile(np.array([-np.inf, *[LEAST_SLOPE] * (size - 1)]), count)
    if (found < least).any():
        factor = np.linalg.cholesky(normal)
        found = lsq_linear(factor.T, np.linalg.solve(factor, right), (least, np.inf), method="bvls").x
    return np.asarray(found, np.float64).reshape(count, size)


def _prior(free: Floats) -> tuple[Floats, Floats]:
    """Normal equations of a curve's priors."""
    bends = np.zeros((len(IDENTITY) - 2, len(IDENTITY)))
    for row, (a, b, c) in enumerate(zip(IDENTITY, IDENTITY[1:], IDENTITY[2:])):
        # Twice the divided difference: the second derivative of the parabola through three controls.
        bends[row, row : row + 3] = 2 / ((a - b) * (a - c)), 2 / ((b - a) * (b - c)), 2 / ((c - a) * (c - b))
    curved = bends @ free / CURVATURE
    departure = free / DEPARTURE
    return curved.T @ curved + departure.T @ departure, departure.T @ IDENTITY / DEPARTURE

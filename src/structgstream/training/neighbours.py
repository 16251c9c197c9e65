# SPDX-License-Identifier: Apache-2.0
"""Nearest neighbours in space."""

from typing import Any

import torch
from torch import Tensor

from structgstream.errors import MissingExtraError


def kd_tree(points: Tensor) -> Any:
    """SciPy's ``KDTree`` of ``points`` ``[P, 3]``, float64.

    Raises:
        MissingExtraError: SciPy is not installed.
    """
    try:
        from scipy.spatial import KDTree
    except ImportError as error:
        raise MissingExtraError("scipy", "capture") from error
    return KDTree(points.double().numpy(force=True))


def nearest(points: Tensor, among: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Rows and distances ``[P, N]`` of the ``count`` (or all) nearest ``among`` to each of ``points`` ``[P, 3]``.

    Raises:
        MissingExtraError: SciPy is not installed.
    """
    ranks = list(range(1, min(count, len(among)) + 1))  # A list: one neighbour has two dimensions, too.
    wanted = points.double().numpy(force=True)
    distances, rows = kd_tree(among).query(wanted, k=ranks, workers=torch.get_num_threads())
    return torch.from_numpy(rows).to(points.device, torch.int64), torch.from_numpy(distances).to(points)


BANDWIDTH = 0.7
"""Standard deviation of the Gaussian weight of a neighbour by distance, relative to the farthest neighbour's."""


def weights_by_distance(distances: Tensor) -> Tensor:
    """The weight of each neighbour by its distance ``[P, N]``, ascending."""
    spread = BANDWIDTH * distances[:, -1:].clamp(min=1e-9)
    return torch.exp(-0.5 * (distances / spread).square())


def nearest_others(points: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Rows and distances ``[P, N]`` of the ``count`` (or all) nearest others to each of ``points`` ``[P, 3]``.

    Raises:
        MissingExtraError: SciPy is not installed.
    """
    count = min(count, len(points) - 1)
    rows, distances = nearest(points, points, count + 1)
    # Of points at one place any may come first: each is taken out of its own neighbours wherever it is.
    itself = rows == torch.arange(len(rows), device=rows.device)[:, None]
    itself[~itself.any(1), -1] = True
    return rows[~itself].reshape(-1, count), distances[~itself].reshape(-1, count)

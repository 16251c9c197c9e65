# SPDX-License-Identifier: Apache-2.0
"""How much rows differ from their neighbours in pure torch: the oracle."""

from torch import Tensor


def neighbour_difference(values: Tensor, neighbours: Tensor, shares: Tensor, *, slack: float) -> Tensor:
    """See ``kernels.operations.NeighbourDifference``."""
    # index_select and its gradient take four fifths of the time of indexing by a matrix.
    others = values.index_select(0, neighbours.reshape(-1)).reshape(*neighbours.shape, 3)
    squares = (others - values[:, None]).square().sum(-1)
    return (shares * ((squares + slack**2).sqrt() - slack)).sum()

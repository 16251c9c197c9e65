# SPDX-License-Identifier: Apache-2.0
"""3D displacements from optical flow in this package's C++; the contract is ``kernels.operations.Lift``."""

import torch
from torch import Tensor

from structgstream.errors import OutOfMemoryError
from structgstream.kernels._load import native_library
from structgstream.kernels.motion_types import Lifted, Neighbors, ViewFlows
from structgstream.kernels.prototypes import addresses


def lift(centers: Tensor, seen: ViewFlows, neighbors: Neighbors, priors: Tensor, *, share: float) -> Lifted:
    """See ``kernels.operations.Lift``; float32.

    Raises:
        OutOfMemoryError: there is no memory for the terms of one target per thread.
    """
    views, movers = seen.weights.shape
    targets, count = neighbors.rows.shape
    assert centers.shape == (movers, 3), centers.shape
    assert seen.flows.shape == (views, movers, 2), seen.flows.shape
    assert neighbors.affinities.shape == (targets, count), neighbors.affinities.shape
    assert priors.shape == (targets, 3), priors.shape
    assert seen.viewmats.shape == (views, 4, 4), seen.viewmats.shape
    assert seen.Ks.shape == (views, 3, 3), seen.Ks.shape
    rows = neighbors.rows.to(torch.int64).contiguous()
    assert not targets or 0 <= int(rows.min()) <= int(rows.max()) < movers, "rows of movers"
    given = [t.detach().float().contiguous() for t in (centers, *seen)]
    pulls = [t.detach().float().contiguous() for t in (neighbors.affinities, priors)]
    found = Lifted(torch.empty(targets, 3), torch.empty(targets), torch.empty(targets, dtype=torch.int64))
    failed = native_library().sgs_lift_flow(
        *addresses(*given, rows, *pulls),
        movers,
        targets,
        views,
        count,
        share,
        *addresses(found.displacements, found.inlier_share, found.agreeing_views),
        torch.get_num_threads(),
    )
    if failed:
        raise OutOfMemoryError("to lift flow to displacements")
    return found

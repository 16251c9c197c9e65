# SPDX-License-Identifier: Apache-2.0
"""Flow lifted to displacements in this package's C++; the contract is ``kernels.reference_lift``'s."""

import ctypes

import torch
from torch import Tensor

from structgstream.errors import OutOfMemoryError
from structgstream.kernels._load import native_library
from structgstream.kernels.reference_lift import Lifted


def lift(
    centers: Tensor,
    weights: Tensor,
    flows: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    near: Tensor,
    neighbours: Tensor,
    affinities: Tensor,
    priors: Tensor,
    *,
    share: float,
) -> Lifted:
    """Displacements of ``T`` targets, see ``kernels.reference_lift.lift``; float32.

    Raises:
        OutOfMemoryError: there is no room for the terms of one target a thread.
    """
    views, movers = weights.shape
    targets, count = neighbours.shape
    assert centers.shape == (movers, 3), centers.shape
    assert flows.shape == (views, movers, 2), flows.shape
    assert affinities.shape == (targets, count), affinities.shape
    assert priors.shape == (targets, 3), priors.shape
    assert viewmats.shape == (views, 4, 4), viewmats.shape
    assert Ks.shape == (views, 3, 3), Ks.shape
    assert not targets or 0 <= int(neighbours.min()) <= int(neighbours.max()) < movers, "rows of movers"
    given = [t.detach().float().contiguous() for t in (centers, weights, flows, viewmats, Ks, near)]
    rows = neighbours.to(torch.int64).contiguous()
    pulls = [t.detach().float().contiguous() for t in (affinities, priors)]
    found = Lifted(torch.empty(targets, 3), torch.empty(targets), torch.empty(targets, dtype=torch.int64))
    results = (found.displacements, found.inlier_share, found.agreeing_views)
    failed = native_library().sgs_lift_flow(
        *(ctypes.c_void_p(t.data_ptr()) for t in (*given, rows, *pulls)),
        ctypes.c_int64(movers),
        ctypes.c_int64(targets),
        ctypes.c_int(views),
        ctypes.c_int(count),
        ctypes.c_float(share),
        *(ctypes.c_void_p(t.data_ptr()) for t in results),
        ctypes.c_int(torch.get_num_threads()),
    )
    if failed:
        raise OutOfMemoryError("to lift flow to displacements")
    return found

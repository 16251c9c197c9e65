# SPDX-License-Identifier: Apache-2.0
"""3D displacements from optical flow in pure torch: the oracle."""

import torch
from torch import Tensor

from structgstream.kernels.motion_types import Lifted, Neighbors, ViewFlows

LEAST_TOLERANCE, TOLERANCE_SHARE = 1.0, 0.1
"""Tolerance of an observed flow f: the first plus the second times |f|, in the unit of f.

The unit is the error of the flow of what hardly moves (``training/online/scene_flow.py``). The second covers what grows
with the displacement: the linearised projection, rotation of the object (one displacement fits several neighbours), and
errors of the search on large motion, together 5 to 10 per cent of |f|."""
ROBUST_SCALES = (4.0, 2.5, 1.5, 1.5, 1.0, 1.0)
"""Scale of the Geman-McClure weights in each round after the first, which has none, in tolerances."""
INLIER_SCALE = 1.5
"""A flow whose residual is below this, in tolerances, is an inlier."""
PRIOR_SHARE, PRIOR_FLOOR = 0.02, 0.05


def projection_jacobians(centers: Tensor, viewmats: Tensor, Ks: Tensor, near: Tensor) -> Tensor:
    """Jacobians ``[V, E, 2, 3]`` of each point's projection, pixels per unit; zero in front of the near plane."""
    points = torch.einsum("vij,ej->vei", viewmats[:, :3, :3], centers) + viewmats[:, None, :3, 3]
    x, y, z = points.unbind(-1)
    front = z > near[:, None]
    z = torch.where(front, z, 1.0)
    zero = torch.zeros_like(z)
    fx, fy = Ks[:, 0, 0, None], Ks[:, 1, 1, None]
    local = torch.stack([fx / z, zero, -fx * x / z**2, zero, fy / z, -fy * y / z**2], -1).unflatten(-1, (2, 3))
    return (local @ viewmats[:, None, :3, :3]) * front[..., None, None]


def lift(centers: Tensor, seen: ViewFlows, neighbors: Neighbors, priors: Tensor, *, share: float) -> Lifted:
    """See ``kernels.operations.Lift``."""
    jacobians = projection_jacobians(centers, seen.viewmats, seen.Ks, seen.near)
    usable = seen.weights * (jacobians.abs().sum((-1, -2)) > 0)
    w = neighbors.affinities[None] * usable[:, neighbors.rows]  # [V, T, N]
    J, f = jacobians[:, neighbors.rows], seen.flows[:, neighbors.rows]
    total = w.sum((0, 2))
    stiffness = (w * J.square().sum((-1, -2))).sum((0, 2)) / (2.0 * total.clamp(min=1e-12))
    eye = torch.eye(3, dtype=centers.dtype, device=centers.device)
    tolerances = LEAST_TOLERANCE + TOLERANCE_SHARE * f.norm(dim=-1)  # [V, T, N]
    d = priors
    for scale in (None, *ROBUST_SCALES):
        now = w
        if scale is not None:
            now = w / (1.0 + _squared(J, f, d) / (scale * tolerances).square()).square()
        reg = (PRIOR_SHARE * now.sum((0, 2)) + PRIOR_FLOOR) * stiffness.clamp(min=1e-12)
        A = torch.einsum("vtn,vtnki,vtnkj->tij", now, J, J) + reg[:, None, None] * eye
        b = torch.einsum("vtn,vtnki,vtnk->ti", now, J, f) + reg[:, None] * priors
        d = torch.linalg.solve(A, b)
    d = torch.where((total > 0)[:, None], d, priors)
    inlier = w * (_squared(J, f, d) < (INLIER_SCALE * tolerances).square())
    of_view, agreed = w.sum(2), inlier.sum(2)  # [V, T]
    return Lifted(
        d,
        agreed.sum(0) / total.clamp(min=1e-12),
        ((agreed > share * of_view) & (of_view > 0)).sum(0),
    )


def _squared(J: Tensor, f: Tensor, d: Tensor) -> Tensor:
    """Squared residual of the flow under a displacement ``[T, 3]``, ``[V, T, N]`` square pixels."""
    return (torch.einsum("vtnki,ti->vtnk", J, d) - f).square().sum(-1)

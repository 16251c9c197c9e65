# SPDX-License-Identifier: Apache-2.0
"""Displacements in space from flow in pictures, in pure torch: the oracle."""

from dataclasses import dataclass

import torch
from torch import Tensor

ROBUST_PIXELS = (4.0, 2.5, 1.5, 1.5, 1.0, 1.0)
"""Scale of the Geman-McClure weights in each round after the first, which trusts everything."""
INLIER_PIXELS = 1.5
PRIOR_SHARE, PRIOR_FLOOR = 0.02, 0.05


@dataclass(frozen=True)
class Lifted:
    """What :func:`lift` found.

    Args:
        displacements: ``[T, 3]``.
        inlier_share: ``[T]`` weight of the flow that agrees within 1.5 pixels, against all of it; 0 without any.
        agreeing_views: ``[T]`` int64, views of which more than ``share`` of the flow agrees.
    """

    displacements: Tensor
    inlier_share: Tensor
    agreeing_views: Tensor


def projection_jacobians(centers: Tensor, viewmats: Tensor, Ks: Tensor, near: Tensor) -> Tensor:
    """Pixels by which each camera sees each point move for a unit of displacement, ``[V, E, 2, 3]``; zero before
    the near plane."""
    points = torch.einsum("vij,ej->vei", viewmats[:, :3, :3], centers) + viewmats[:, None, :3, 3]
    x, y, z = points.unbind(-1)
    front = z > near[:, None]
    z = torch.where(front, z, 1.0)
    zero = torch.zeros_like(z)
    fx, fy = Ks[:, 0, 0, None], Ks[:, 1, 1, None]
    local = torch.stack([fx / z, zero, -fx * x / z**2, zero, fy / z, -fy * y / z**2], -1).unflatten(-1, (2, 3))
    return (local @ viewmats[:, None, :3, :3]) * front[..., None, None]


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
    """For each target the displacement d that explains the flow of its neighbours best, in all views at once.

    Minimises ``sum g W rho(J d - f) + reg |d - prior|^2`` over neighbours and views, with Geman-McClure weights
    ``1 / (1 + r^2 / s^2)^2`` of falling scale s (:data:`ROBUST_PIXELS`) after one round without them.
    ``reg = (0.02 sum + 0.05)`` times the mean square of J, where ``sum`` is that of the present weights.

    Args:
        centers: ``[E, 3]`` of movers.
        weights: ``[V, E]`` W, pixels of flow.
        flows: ``[V, E, 2]`` f, pixels.
        viewmats: ``[V, 4, 4]``.
        Ks: ``[V, 3, 3]`` of the pictures in whose pixels f is.
        near: ``[V]``.
        neighbours: ``[T, N]`` int64, rows of movers.
        affinities: ``[T, N]`` g.
        priors: ``[T, 3]``.
        share: of :class:`Lifted`.
    """
    jacobians = projection_jacobians(centers, viewmats, Ks, near)
    usable = weights * (jacobians.abs().sum((-1, -2)) > 0)
    w = affinities[None] * usable[:, neighbours]  # [V, T, N]
    J, f = jacobians[:, neighbours], flows[:, neighbours]
    total = w.sum((0, 2))
    stiffness = (w * J.square().sum((-1, -2))).sum((0, 2)) / (2.0 * total.clamp(min=1e-12))
    eye = torch.eye(3, dtype=centers.dtype, device=centers.device)
    d = priors
    for scale in (None, *ROBUST_PIXELS):
        now = w
        if scale is not None:
            now = w / (1.0 + _squared(J, f, d) / scale**2).square()
        reg = (PRIOR_SHARE * now.sum((0, 2)) + PRIOR_FLOOR) * stiffness.clamp(min=1e-12)
        A = torch.einsum("vtn,vtnki,vtnkj->tij", now, J, J) + reg[:, None, None] * eye
        b = torch.einsum("vtn,vtnki,vtnk->ti", now, J, f) + reg[:, None] * priors
        d = torch.linalg.solve(A, b)
    d = torch.where((total > 0)[:, None], d, priors)
    inlier = w * (_squared(J, f, d) < INLIER_PIXELS**2)
    of_view, agreed = w.sum(2), inlier.sum(2)  # [V, T]
    return Lifted(
        d,
        agreed.sum(0) / total.clamp(min=1e-12),
        ((agreed > share * of_view) & (of_view > 0)).sum(0),
    )


def _squared(J: Tensor, f: Tensor, d: Tensor) -> Tensor:
    """Squared length in pixels of what a displacement ``[T, 3]`` leaves of the flow, ``[V, T, N]``."""
    return (torch.einsum("vtnki,ti->vtnk", J, d) - f).square().sum(-1)

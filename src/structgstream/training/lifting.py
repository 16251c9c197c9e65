# SPDX-License-Identifier: Apache-2.0
"""Flow in the training pictures, lifted to a displacement of every mover (Note [Movers])."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from structgstream.errors import MissingExtraError
from structgstream.kernels.backend import Backend
from structgstream.kernels.motion_types import Neighbors, ViewFlows
from structgstream.training.observation import MotionEvidence
from structgstream.training.views import View


@dataclass(frozen=True)
class LiftConfig:
    """How flow becomes motion."""

    neighbours: int = 12
    """A mover follows the flow of so many movers nearest to it, itself among them."""
    bandwidth: float = 0.7
    """Standard deviation of the weight of a neighbour by distance, in distances to the farthest of them."""
    color_bandwidth: float = 0.15
    """Standard deviation of the weight of a neighbour by difference in colour, in 0 ... 1: a hand and a ball do not
    share a motion. 0: colours do not count."""
    inlier_share: float = 0.4
    """A displacement counts when so much of the flow agrees with it ..."""
    agreeing_views: int = 2
    """... in so many views; else a mover begins where its last step leads."""


@dataclass(frozen=True)
class LiftedMotion:
    """Where movers ``[T]`` begin a frame.

    Args:
        displacements: ``[T, 3]`` from where they are.
        lifted: mask ``[T]`` of those that follow flow; the others follow their last step.
    """

    displacements: Tensor
    lifted: Tensor


def lift_motion(
    evidence: MotionEvidence,
    centers: Tensor,
    priors: Tensor,
    views: Sequence[View],
    *,
    config: LiftConfig,
    backend: Backend,
) -> LiftedMotion:
    """A displacement for each of ``T`` movers.

    Args:
        evidence: of these movers.
        centers: ``[T, 3]`` where they are seen.
        priors: ``[T, 3]`` where they would go by themselves.
        views: in the evidence's order; flow is in their pixels.
        config: how.
        backend: what computes.

    Raises:
        MissingExtraError: SciPy is not installed.
    """
    informed = (evidence.weights.amax(0) > 0).nonzero()[:, 0]
    if not len(informed):
        return LiftedMotion(priors, torch.zeros(len(priors), dtype=torch.bool, device=priors.device))
    near, distances = _nearest(centers, centers[informed], config.neighbours)
    spread = config.bandwidth * distances[:, -1:].clamp(min=1e-9)
    affinities = torch.exp(-0.5 * (distances / spread).square())
    neighbours = informed[near]
    if config.color_bandwidth > 0.0:
        apart = (evidence.colors[neighbours] - evidence.colors[:, None]).square().sum(-1)
        affinities = affinities * torch.exp(-0.5 * apart / config.color_bandwidth**2)
    viewports = [view.camera.viewport(centers) for view in views]
    seen = ViewFlows(
        evidence.weights,
        evidence.flows,
        torch.stack([viewport.viewmat for viewport in viewports]),
        torch.stack([viewport.K for viewport in viewports]),
        centers.new_tensor([viewport.near for viewport in viewports]),
    )
    found = backend.lift(centers, seen, Neighbors(neighbours, affinities), priors, share=config.inlier_share)
    lifted = (found.inlier_share > config.inlier_share) & (found.agreeing_views >= config.agreeing_views)
    displacements = torch.where(lifted[:, None], found.displacements, priors)
    return LiftedMotion(displacements, lifted)


def _nearest(points: Tensor, among: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """The ``count`` of ``among`` (or all of them) nearest to each of ``points``: rows and distances ``[T, N]``."""
    try:
        from scipy.spatial import KDTree
    except ImportError as error:
        raise MissingExtraError("scipy", "capture") from error
    count = min(count, len(among))
    ranks: Any = list(range(1, count + 1))  # A list, so that one neighbour is a column too.
    distances, rows = KDTree(among.double().numpy(force=True)).query(points.double().numpy(force=True), k=ranks)
    return torch.from_numpy(rows).to(points.device, torch.int64), torch.from_numpy(distances).to(points)

# SPDX-License-Identifier: Apache-2.0
"""3D displacements of movers (Note [Movers]) from optical flow in the training pictures."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from structgstream.kernels.backend import Backend
from structgstream.kernels.values import Neighbors, ViewFlows
from structgstream.training.neighbours import nearest
from structgstream.training.observation import MotionEvidence
from structgstream.training.views import View


@dataclass(frozen=True)
class LiftConfig:
    """Robust fit of displacements to the flow of neighbouring movers; not in the paper."""

    neighbours: int = 12
    """Number of nearest movers, including itself, whose flow a displacement is fitted to."""
    bandwidth: float = 0.7
    """Standard deviation of the Gaussian weight of a neighbour by distance, relative to the farthest neighbour's."""
    color_bandwidth: float = 0.15
    """Standard deviation of the Gaussian weight of a neighbour by colour difference (full scale 1), which separates
    adjacent objects. 0: no weight by colour."""
    inlier_share: float = 0.4
    """Least share of inliers of a valid displacement, over all flow and in each agreeing view."""
    agreeing_views: int = 2
    """Least number of agreeing views; otherwise a mover takes the motion prior."""


@dataclass(frozen=True)
class LiftedMotion:
    """Initial displacements of ``T`` movers in a frame.

    Args:
        displacements: ``[T, 3]``.
        lifted: mask ``[T]`` of those fitted to flow; the others have their prior.
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
        centers: ``[T, 3]`` visible centres.
        priors: ``[T, 3]`` displacements expected without flow.
        views: in the evidence's order; flow is in their pixels.
        config: of the fit.
        backend: the compute back-end.

    Raises:
        MissingExtraError: SciPy is not installed.
    """
    informed = (evidence.weights.amax(0) > 0).nonzero()[:, 0]
    if not len(informed):
        return LiftedMotion(priors, torch.zeros(len(priors), dtype=torch.bool, device=priors.device))
    near, distances = nearest(centers, centers[informed], config.neighbours)
    spread = config.bandwidth * distances[:, -1:].clamp(min=1e-9)
    affinities = torch.exp(-0.5 * (distances / spread).square())
    neighbours = informed[near]
    if config.color_bandwidth > 0.0:
        apart = (evidence.colors[neighbours] - evidence.colors[:, None]).square().sum(-1)
        affinities = affinities * torch.exp(-0.5 * apart / config.color_bandwidth**2)
    viewports = [view.camera.viewport(centers) for view in views]
    # The tolerance has a unit of one pixel at the reference size: errors of the flow of what hardly moves come from how
    # bodies bend, from occlusion and from blending, which are as large in space however many pixels show them.
    noise = centers.new_tensor([view.enlargement for view in views])
    per_noise = torch.stack([1.0 / noise, 1.0 / noise, torch.ones_like(noise)], dim=-1)
    seen = ViewFlows(
        evidence.weights,
        evidence.flows / noise[:, None, None],
        torch.stack([viewport.viewmat for viewport in viewports]),
        torch.stack([viewport.K for viewport in viewports]) * per_noise[..., None],
        centers.new_tensor([viewport.near for viewport in viewports]),
    )
    found = backend.lift(centers, seen, Neighbors(neighbours, affinities), priors, share=config.inlier_share)
    lifted = (found.inlier_share > config.inlier_share) & (found.agreeing_views >= config.agreeing_views)
    displacements = torch.where(lifted[:, None], found.displacements, priors)
    return LiftedMotion(displacements, lifted)

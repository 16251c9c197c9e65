# SPDX-License-Identifier: Apache-2.0
"""A regulariser of frame 0 that concentrates the Gaussians along a ray in depth.

A haze of faint Gaussians around a surface can fit every training view and be wrong in all others; its depths along a
ray are spread. The loss is the standard deviation of depth relative to its mean (compare the distortion loss of
Mip-NeRF 360, Barron et al., CVPR 2022).
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from structgstream.cameras import Camera
from structgstream.gaussians import Gaussians
from structgstream.kernels.backend import Backend

COVERED = 0.5
"""Rays with less coverage are not counted."""


@dataclass(frozen=True)
class SolidityConfig:
    """Weight and schedule of the depth regulariser; not in the paper."""

    weight: float = 0.0
    """Mean weight of the depth spread in the loss per iteration (paper: 0)."""
    from_share: float = 0.3
    """Share of the iterations before it starts, in which surfaces form."""
    every: int = 2
    """It is computed in every ``every``-th iteration, with ``every`` times the weight."""
    scale: float = 0.5
    """Scale of width and height of the pictures in which depth is drawn."""

    def weight_at(self, iteration: int, iterations: int) -> float:
        """Weight of the depth spread in ``iteration`` of ``iterations``; 0: it is not computed."""
        if iteration <= self.from_share * iterations or iteration % self.every:
            return 0.0
        return self.weight * self.every


def depth_spread(gaussians: Gaussians, camera: Camera, *, scale: float, backend: Backend) -> Tensor:
    """Relative spread of depth along rays, ``[]``.

    The standard deviation of depth, weighted by blending weights, relative to the mean depth, averaged over the pixels
    with coverage above :data:`COVERED`. It takes one more rendering, with "colours" z, z^2 and 1.
    """
    small = camera.resized(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
    viewport = small.viewport(gaussians.means)
    depths = gaussians.means @ viewport.viewmat[2, :3] + viewport.viewmat[2, 3]
    moments = torch.stack([depths, depths.square(), torch.ones_like(depths)], dim=1)
    image = backend.rasterize(replace(gaussians, colors=moments), viewport).image
    first, second, coverage = image.unbind(-1)
    covered = coverage.detach() > COVERED
    divisor = coverage.clamp(min=COVERED)  # Avoids NaN in pixels that are not counted.
    mean = (first / divisor).clamp(min=small.near)
    variance = (second / divisor - mean.square()).clamp(min=0.0)
    spread = (variance + 1e-8).sqrt() / mean
    return (spread * covered).sum() / covered.sum().clamp(min=1)

# SPDX-License-Identifier: Apache-2.0
"""What makes surfaces of frame 0 solid: Gaussians along a ray are drawn together.

A haze of faint Gaussians before and behind a surface can look right from every training camera and wrong from any
other. Its depth tells: along a ray it is spread. (Deviation of depth along a ray relative to its mean; compare the
distortion loss of Mip-NeRF 360, Barron et al., CVPR 2022.)
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from structgstream.cameras import Camera
from structgstream.gaussians import Gaussians
from structgstream.kernels.backend import Backend

COVERED = 0.5
"""Rays with less coverage have no surface."""


@dataclass(frozen=True)
class SolidityConfig:
    """When and how much depth is drawn together."""

    weight: float = 0.0
    """Of the spread of depth in the loss, as if it were added in every iteration (paper: 0)."""
    from_share: float = 0.3
    """Of the iterations are over before it begins: first there must be surfaces."""
    every: int = 2
    """It is added in one iteration of so many, with as many times the weight."""
    scale: float = 0.5
    """Depth is drawn in this share of the picture's width and height."""

    def weight_at(self, iteration: int, iterations: int) -> float:
        """What the spread of depth counts in ``iteration`` of ``iterations``; 0: it need not be known."""
        if iteration <= self.from_share * iterations or iteration % self.every:
            return 0.0
        return self.weight * self.every


def depth_spread(gaussians: Gaussians, camera: Camera, *, scale: float, backend: Backend) -> Tensor:
    """How far from each other the Gaussians lie that a pixel shows, ``[]``.

    The standard deviation of depth by blending weights as a share of the mean depth, averaged over the pixels that are
    covered by more than :data:`COVERED`. Drawn with the "colours" z, z^2 and 1 this is one more picture.
    """
    small = camera.resized(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
    viewport = small.viewport(gaussians.means)
    depths = gaussians.means @ viewport.viewmat[2, :3] + viewport.viewmat[2, 3]
    moments = torch.stack([depths, depths.square(), torch.ones_like(depths)], dim=1)
    image = backend.rasterize(replace(gaussians, colors=moments), viewport).image
    first, second, coverage = image.unbind(-1)
    covered = coverage.detach() > COVERED
    divisor = coverage.clamp(min=COVERED)  # Not NaN where nothing is drawn, though that does not count.
    mean = (first / divisor).clamp(min=small.near)
    variance = (second / divisor - mean.square()).clamp(min=0.0)
    spread = (variance + 1e-8).sqrt() / mean
    return (spread * covered).sum() / covered.sum().clamp(min=1)

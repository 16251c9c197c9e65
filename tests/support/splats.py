# SPDX-License-Identifier: Apache-2.0
"""Values that rasterisers take, of plain tensors, for tests."""

import torch
from torch import Tensor

from structgstream.cameras import Viewport
from structgstream.gaussians import Gaussians


def splats_of(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor, intervals: Tensor | None = None
) -> Gaussians:
    """Gaussians numbered from 0 on."""
    ids = torch.arange(len(means), device=means.device)
    return Gaussians(means, quats, scales, opacities, colors, ids, intervals)


def viewport_of(viewmat: Tensor, K: Tensor, *, width: int, height: int, near: float) -> Viewport:
    """A camera of matrices in any precision."""
    return Viewport(viewmat, K, -viewmat[:3, :3].T @ viewmat[:3, 3], width, height, near)

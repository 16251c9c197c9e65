# SPDX-License-Identifier: Apache-2.0
"""Flow where it is consistent, in pure torch: the oracle."""

import torch
from torch import Tensor
from torch.nn.functional import grid_sample


def confident_flow(flow: Tensor, back: Tensor, mask: Tensor | None, *, relative: float, absolute: float) -> Tensor:
    """See ``kernels.operations.ConfidentFlow``."""
    height, width = flow.shape[:2]
    x = flow[..., 0] + torch.arange(width)
    y = flow[..., 1] + torch.arange(height)[:, None]
    grid = torch.stack([x * (2 / max(width - 1, 1)) - 1, y * (2 / max(height - 1, 1)) - 1], dim=-1)
    planes = back.permute(2, 0, 1)[None]
    returned = grid_sample(planes, grid[None], mode="bilinear", padding_mode="border", align_corners=True)[0]
    there = flow.permute(2, 0, 1)
    rest = (there + returned).square().sum(0)
    lengths = there.square().sum(0) + returned.square().sum(0)
    inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    agree = (rest <= relative * lengths + absolute) & inside
    agree = agree if mask is None else agree & mask
    return torch.where(agree, torch.cat([torch.ones(1, height, width), there]), 0.0)

# SPDX-License-Identifier: Apache-2.0
"""Plane sweep for new content: each ray's depth by agreement between views, in pure torch: the oracle."""

from collections.abc import Sequence

import torch
from torch import Tensor

from structgstream.kernels.motion_types import SweepView, Swept

SUPPORTING, CONTRADICTING = 0.3, 0.05
"""A view supports a point at pixels with ``missing`` above the first, and contradicts it below the second."""
FRONT_SHARE = 1.03
"""A point counts as in front of the rendered depth up to this multiple of it."""
MOST_DIFFERENCE = 0.3
MISS_COST, LONELY_COST = 0.15, 0.05
EQUAL_COST = 0.01


def sweep(
    views: Sequence[SweepView],
    view_index: int,
    pixels: Tensor,
    farthest: Tensor,
    *,
    planes: int,
    least_supports: int,
    most_contradictions: float,
) -> Swept:
    """See ``kernels.operations.Sweep``."""
    own = views[view_index]
    x, y = pixels.unbind(1)
    steps = torch.linspace(0.0, 1.0, planes, dtype=farthest.dtype, device=farthest.device)
    inverse = 1.0 / own.near + steps * (1.0 / farthest[:, None] - 1.0 / own.near)
    z = 1.0 / inverse  # [P, planes]
    fx, fy, cx, cy = own.K[0, 0], own.K[1, 1], own.K[0, 2], own.K[1, 2]
    rays = torch.stack([(x + 0.5 - cx) / fx, (y + 0.5 - cy) / fy, torch.ones_like(farthest)], -1)
    points = rays[:, None] * z[..., None] - own.viewmat[:3, 3]
    points = points @ own.viewmat[:3, :3]  # rows of points times R is R^T times points
    colors = own.colors[y, x]
    supports, contradictions, difference = (torch.zeros_like(z) for _ in range(3))
    for index, view in enumerate(views):
        if index == view_index:
            continue
        seen = points @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
        depth = seen[..., 2]
        front = depth > view.near
        safe = torch.where(front, depth, 1.0)
        column = (view.K[0, 0] * seen[..., 0] / safe + view.K[0, 2]).floor()
        row = (view.K[1, 1] * seen[..., 1] / safe + view.K[1, 2]).floor()
        height, width = view.missing.shape
        inside = front & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        at = (row.clamp(0, height - 1).long(), column.clamp(0, width - 1).long())
        visible = inside & (depth < FRONT_SHARE * view.depths[at])
        supporting = visible & (view.missing[at] > SUPPORTING)
        apart = (view.colors[at] - colors[:, None]).abs().mean(-1).clamp(max=MOST_DIFFERENCE)
        supports += supporting
        difference += supporting * apart
        contradictions += visible & (view.missing[at] < CONTRADICTING)
    share = contradictions / (supports + contradictions).clamp(min=1.0)
    some = supports.clamp(min=1.0)
    costs = difference / some + MISS_COST * share + LONELY_COST / some
    costs = torch.where((supports >= least_supports) & (share <= most_contradictions), costs, torch.inf)
    least, plane = _middle_of_cheapest(costs)
    return Swept(torch.where(least.isfinite(), z.gather(1, plane)[:, 0], 0.0), least)


def _middle_of_cheapest(costs: Tensor) -> tuple[Tensor, Tensor]:
    """Least cost ``[P]`` of each row of ``costs`` ``[P, planes]``, and the middle plane ``[P, 1]`` of the run of nearly
    equal costs around it, as on textureless surfaces."""
    planes = costs.shape[1]
    best = costs.argmin(1, keepdim=True)
    least = costs.gather(1, best)
    worse = ~(costs <= least + EQUAL_COST)
    plane = torch.arange(planes, device=costs.device).expand_as(costs)
    first = torch.where(worse & (plane < best), plane, -1).amax(1, keepdim=True) + 1
    last = torch.where(worse & (plane > best), plane, planes).amin(1, keepdim=True) - 1
    return least[:, 0], (first + last) // 2

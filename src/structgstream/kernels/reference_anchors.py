# SPDX-License-Identifier: Apache-2.0
"""Anchors to drawable Gaussians in pure torch: the oracle of culling and generation."""

import torch
from torch import Tensor

from structgstream.cameras import Viewport
from structgstream.gaussians import Gaussians
from structgstream.kernels.reference_raster import LOW_PASS_PIXELS
from structgstream.kernels.values import (
    TILE_PIXELS,
    Anchors,
    HeadWeights,
    MLPWeights,
    StructuredGaussians,
    TileSelection,
)

BALL_DEVIATIONS = 3.4
"""Radius of a Gaussian in standard deviations: alpha falls below 1/255 before 3.33 at any opacity."""
BOX_MARGIN_PIXELS = 2.0
"""Margin for the rasteriser's low-pass filter, which widens the smallest Gaussian to this."""
BALL_INTERVALS = BALL_DEVIATIONS * LOW_PASS_PIXELS**0.5
"""The low-pass of a Gaussian widens its ball by so many sampling intervals."""


def visible_anchors(
    anchors: Anchors, viewport: Viewport, tiles: TileSelection | None, intervals: Tensor | None = None
) -> Tensor:
    """Indices ``[m]`` int64, ascending, of the anchors whose ball of Gaussians reaches the picture, or one of the
    ``tiles``."""
    size = (viewport.width, viewport.height)
    with torch.no_grad():
        points = anchors.positions @ viewport.viewmat[:3, :3].T + viewport.viewmat[:3, 3]  # [M, 3]
        reach = (anchors.offsets * anchors.log_offset_scales.exp()[:, None]).norm(dim=-1).amax(1)
        radius = reach + BALL_DEVIATIONS * anchors.log_base_scales.amax(1).exp()  # [M]
        if intervals is not None:
            radius = radius + BALL_INTERVALS * intervals
        closest, furthest = points[:, 2] - radius, points[:, 2] + radius
        seen = furthest > viewport.near
        low, high = [], []
        for axis in range(2):
            below, above = points[:, axis] - radius, points[:, axis] + radius
            focal, center = viewport.K[axis, axis], viewport.K[axis, 2]
            at_low = below / torch.where(below < 0, closest, furthest)
            at_high = above / torch.where(above < 0, furthest, closest)
            low.append(focal * at_low + center - BOX_MARGIN_PIXELS)
            high.append(focal * at_high + center + BOX_MARGIN_PIXELS)
            # A ball that contains the camera plane has no box: it counts unless it lies outside a frustum side.
            around = closest <= 0
            for sign, edge in ((1.0, center), (-1.0, size[axis] - center)):
                slope = (edge + BOX_MARGIN_PIXELS) / focal
                distance = (sign * points[:, axis] + slope * points[:, 2]) / (1.0 + slope**2).sqrt()
                seen &= ~around | (distance > -1.1 * radius)
            seen &= around | ((low[axis] < size[axis]) & (high[axis] > 0))
            low[axis] = torch.where(around, 0.0, low[axis])
            high[axis] = torch.where(around, float(size[axis]), high[axis])
        if tiles is not None:
            seen &= _reaches(tiles.mask, torch.stack(low, dim=1), torch.stack(high, dim=1), size)
        return seen.nonzero()[:, 0]


def _reaches(tiles: Tensor, low: Tensor, high: Tensor, size: tuple[int, int]) -> Tensor:
    """Mask ``[M]`` of the pixel boxes ``low`` ... ``high`` ``[M, 2]`` that overlap a tile of the mask ``tiles``."""
    covered = torch.zeros(tiles.shape[0] + 1, tiles.shape[1] + 1, dtype=torch.int64, device=tiles.device)
    covered[1:, 1:] = tiles.long().cumsum(0).cumsum(1)
    x0, y0 = (low[:, axis].clamp(0, size[axis] - 1).long() // TILE_PIXELS for axis in range(2))
    x1, y1 = (high[:, axis].clamp(0, size[axis] - 1).long() // TILE_PIXELS + 1 for axis in range(2))
    return covered[y1, x1] - covered[y0, x1] - covered[y1, x0] + covered[y0, x0] > 0


def head_outputs(weights: HeadWeights, inputs: Tensor) -> Tensor:
    """Outputs of an MLP with one hidden layer, before any activation."""
    hidden = torch.relu(torch.nn.functional.linear(inputs, weights.w1, weights.b1))
    return torch.nn.functional.linear(hidden, weights.w2, weights.b2)


def generate_structured(
    anchors: Anchors,
    mlps: MLPWeights,
    viewport: Viewport,
    *,
    distance_input: bool,
    tiles: TileSelection | None = None,
    sampling_intervals: Tensor | None = None,
) -> StructuredGaussians:
    """The Gaussians of the anchors in a camera's view (paper, equations for mu' and Sigma').

    Opacity is the tanh output; only positive ones are drawn. The scale is the base scale times a sigmoid. Culling
    changes the cost of a rendering, never its pixels: it tests a ball that contains all Gaussians of an anchor.

    Args:
        anchors: all of the scene's.
        mlps: the three heads; inputs are the feature (D), the direction (3) and optionally the distance (1).
        viewport: the camera.
        distance_input: whether the distance is an input of the heads.
        tiles: if given, only anchors that reach one of these tiles.
        sampling_intervals: ``[M]`` sampling intervals of the anchors, by which the rasteriser's low-pass enlarges their
            balls.
    """
    visible = visible_anchors(anchors, viewport, tiles, sampling_intervals)
    return activate_anchors(anchors, mlps, viewport.center, visible, distance_input=distance_input)


def activate_anchors(
    anchors: Anchors, mlps: MLPWeights, center: Tensor, visible: Tensor, *, distance_input: bool
) -> StructuredGaussians:
    """The Gaussians of the anchors ``visible`` ``[m]`` int64, ascending, as seen from ``center`` ``[3]``."""
    positions, log_offset_scales, log_base_scales, offsets, features = anchors
    k = offsets.shape[1]
    to_anchor = positions[visible] - center
    distance = to_anchor.norm(dim=1, keepdim=True).clamp_min(1e-12)  # An anchor may lie at the camera's centre.
    parts = [features[visible], to_anchor / distance]
    inputs = torch.cat([*parts, distance] if distance_input else parts, dim=1)
    opacity = torch.tanh(head_outputs(mlps.opacity, inputs))  # [m, K]
    drawn = (opacity.reshape(-1) > 0).nonzero()[:, 0]
    color = torch.sigmoid(head_outputs(mlps.color, inputs)).reshape(-1, 3)[drawn]
    covariance = head_outputs(mlps.covariance, inputs).reshape(-1, 7)[drawn]
    anchor = visible[drawn // k]
    offset = offsets[anchor, drawn % k]
    gaussians = Gaussians(
        means=positions[anchor] + offset * log_offset_scales[anchor].exp(),
        quats=torch.nn.functional.normalize(covariance[:, 3:7], dim=1),
        scales=log_base_scales[anchor].exp() * torch.sigmoid(covariance[:, :3]),
        opacities=opacity.reshape(-1)[drawn],
        colors=color,
        ids=anchor * k + drawn % k,
    )
    return StructuredGaussians(gaussians, visible, opacity.detach())

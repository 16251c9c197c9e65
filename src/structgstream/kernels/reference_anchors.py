# SPDX-License-Identifier: Apache-2.0
"""Anchors to drawable Gaussians in pure torch: the oracle of the culling and of the generation."""

import torch
from torch import Tensor

from structgstream.kernels.anchor_types import HeadWeights, MLPWeights, StructuredGaussians
from structgstream.kernels.raster_types import TILE_PIXELS

BALL_DEVIATIONS = 3.4
"""A Gaussian ends within so many standard deviations: alpha = 1/255 is reached before 3.33 at any opacity."""
BOX_MARGIN_PIXELS = 2.0
"""The rasteriser's low-pass makes the smallest Gaussian this wide."""


def seen_anchors(
    positions: Tensor,
    log_offset_scales: Tensor,
    log_base_scales: Tensor,
    offsets: Tensor,
    viewmat: Tensor,
    K: Tensor,
    *,
    width: int,
    height: int,
    near: float,
    tiles: Tensor | None = None,
) -> Tensor:
    """Mask ``[M]`` bool of the anchors that can put a Gaussian into a picture.

    Conservative: an anchor counts as a ball that holds all its Gaussians, so culling changes the cost of a rendering
    and never its pixels.

    Args:
        positions: ``[M, 3]``.
        log_offset_scales: ``[M, 3]``.
        log_base_scales: ``[M, 3]``.
        offsets: ``[M, K, 3]``.
        viewmat: ``[4, 4]`` world to camera.
        K: ``[3, 3]`` pixels.
        width: pixels.
        height: pixels.
        near: smallest z that is drawn.
        tiles: ``[rows, columns]`` bool: only what reaches one of these tiles counts.
    """
    with torch.no_grad():
        points = positions @ viewmat[:3, :3].T + viewmat[:3, 3]  # [M, 3]
        reach = (offsets * log_offset_scales.exp()[:, None]).norm(dim=-1).amax(1)
        radius = reach + BALL_DEVIATIONS * log_base_scales.amax(1).exp()  # [M]
        closest, furthest = points[:, 2] - radius, points[:, 2] + radius
        size = (width, height)
        seen = furthest > near
        low, high = [], []
        for axis in range(2):
            below, above = points[:, axis] - radius, points[:, axis] + radius
            focal, center = K[axis, axis], K[axis, 2]
            at_low = below / torch.where(below < 0, closest, furthest)
            at_high = above / torch.where(above < 0, furthest, closest)
            low.append(focal * at_low + center - BOX_MARGIN_PIXELS)
            high.append(focal * at_high + center + BOX_MARGIN_PIXELS)
            # A ball as near as its radius has no box: it counts unless it lies beyond a side of the frustum.
            around = closest <= 0
            for sign, edge in ((1.0, center), (-1.0, size[axis] - center)):
                slope = (edge + BOX_MARGIN_PIXELS) / focal
                distance = (sign * points[:, axis] + slope * points[:, 2]) / (1.0 + slope**2).sqrt()
                seen &= ~around | (distance > -1.1 * radius)
            seen &= around | ((low[axis] < size[axis]) & (high[axis] > 0))
            low[axis] = torch.where(around, 0.0, low[axis])
            high[axis] = torch.where(around, float(size[axis]), high[axis])
        if tiles is not None:
            covered = torch.zeros(tiles.shape[0] + 1, tiles.shape[1] + 1, dtype=torch.int64, device=tiles.device)
            covered[1:, 1:] = tiles.long().cumsum(0).cumsum(1)
            x0, y0 = (low[axis].clamp(0, size[axis] - 1).long() // TILE_PIXELS for axis in range(2))
            x1, y1 = (high[axis].clamp(0, size[axis] - 1).long() // TILE_PIXELS + 1 for axis in range(2))
            seen &= covered[y1, x1] - covered[y0, x1] - covered[y1, x0] + covered[y0, x0] > 0
        return seen


def visible_anchors(
    positions: Tensor,
    log_offset_scales: Tensor,
    log_base_scales: Tensor,
    offsets: Tensor,
    viewmat: Tensor,
    K: Tensor,
    *,
    width: int,
    height: int,
    near: float,
    tiles: Tensor | None = None,
) -> Tensor:
    """Indices ``[m]`` int64, ascending, of the anchors that :func:`seen_anchors` marks."""
    seen = seen_anchors(
        positions,
        log_offset_scales,
        log_base_scales,
        offsets,
        viewmat,
        K,
        width=width,
        height=height,
        near=near,
        tiles=tiles,
    )
    return seen.nonzero()[:, 0]


def _head(weights: HeadWeights, inputs: Tensor) -> Tensor:
    hidden = torch.relu(torch.nn.functional.linear(inputs, weights.w1, weights.b1))
    return torch.nn.functional.linear(hidden, weights.w2, weights.b2)


def generate_structured(
    positions: Tensor,
    log_offset_scales: Tensor,
    log_base_scales: Tensor,
    offsets: Tensor,
    features: Tensor,
    mlps: MLPWeights,
    camera_center: Tensor,
    visible: Tensor,
    *,
    distance_input: bool,
) -> StructuredGaussians:
    """Dress the visible anchors for one camera (paper, equations for mu' and Sigma').

    Args:
        positions: ``[M, 3]``, x_v.
        log_offset_scales: ``[M, 3]``, log l_v.
        log_base_scales: ``[M, 3]``, log of the largest Gaussian scale.
        offsets: ``[M, K, 3]``, O_v.
        features: ``[M, D]``, f_v.
        mlps: the three heads; inputs are the feature, the direction (3) and, if asked for, the distance (1).
        camera_center: ``[3]``.
        visible: ``[m]`` int64 anchor indices, ascending.
        distance_input: whether the heads see the distance.

    Opacity is tanh and used as it is, so that only what is positive is drawn; the scale is the base times a sigmoid.
    """
    k = offsets.shape[1]
    to_anchor = positions[visible] - camera_center
    distance = to_anchor.norm(dim=1, keepdim=True).clamp_min(1e-12)  # An anchor may sit in the camera.
    parts = [features[visible], to_anchor / distance]
    inputs = torch.cat([*parts, distance] if distance_input else parts, dim=1)
    opacity = torch.tanh(_head(mlps.opacity, inputs))  # [m, K]
    drawn = (opacity.reshape(-1) > 0).nonzero()[:, 0]
    color = torch.sigmoid(_head(mlps.color, inputs)).reshape(-1, 3)[drawn]
    covariance = _head(mlps.covariance, inputs).reshape(-1, 7)[drawn]
    anchor = visible[drawn // k]
    offset = offsets[anchor, drawn % k]
    return StructuredGaussians(
        means=positions[anchor] + offset * log_offset_scales[anchor].exp(),
        quats=torch.nn.functional.normalize(covariance[:, 3:7], dim=1),
        scales=log_base_scales[anchor].exp() * torch.sigmoid(covariance[:, :3]),
        opacities=opacity.reshape(-1)[drawn],
        colors=color,
        ids=anchor * k + drawn % k,
        raw_opacities=opacity.detach(),
    )

# SPDX-License-Identifier: Apache-2.0
"""Anchors to drawable Gaussians in pure torch: the oracle of the generation."""

import torch
from torch import Tensor

from structgstream.kernels.anchor_types import HeadWeights, MLPWeights, StructuredGaussians


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

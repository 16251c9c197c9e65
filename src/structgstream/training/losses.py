# SPDX-License-Identifier: Apache-2.0
"""The terms of the training loss (paper, equations for L, L_vol, L_init and L_dist)."""

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from structgstream.kernels.backend import Backend
from structgstream.scene.anchors import AnchorCloud


@dataclass(frozen=True)
class LossWeights:
    """Weights of the loss terms; terms of weight zero are not computed."""

    l1: float = 1.0
    """On the mean absolute difference (paper: 1; Scaffold-GS: 0.8)."""
    ssim: float = 0.2
    """On 1 - SSIM, the paper's lambda_SSIM (0.2)."""
    volume: float = 0.01
    """On the product of each drawn Gaussian's scales, the paper's lambda_vol (0.01)."""
    volume_reduction: Literal["mean", "sum"] = "mean"
    """The paper's equation is a sum, Scaffold-GS takes the mean (docs/method.md has both measured)."""
    offset_distance: float = 0.0
    """On L_dist, the paper's lambda_dist (0.005 in frame 0, 0 afterwards)."""
    offset_distance_reduction: Literal["mean", "sum"] = "mean"
    """The paper's equation is a sum over anchors and offsets."""
    offset_distance_reading: Literal["scaled", "raw", "norm"] = "scaled"
    """Compared with 2 eps: ``scaled`` each component of |O * l_v|, ``raw`` of |O|, ``norm`` the norm of O * l_v."""


def volume(scales: Tensor, opacities: Tensor, *, reduction: Literal["mean", "sum"], backend: Backend) -> Tensor:
    """L_vol: the product of the three scales ``[N, 3]`` of every Gaussian with an opacity ``[N]`` above zero.

    The others must have scale 0, so that they add nothing to the sum; a mean counts positive opacities only.
    """
    total, drawn = backend.volume(scales, opacities)
    return total / drawn.clamp(min=1) if reduction == "mean" else total


def offset_distance(anchors: AnchorCloud, *, voxel_size: float, weights: LossWeights, backend: Backend) -> Tensor:
    """L_dist: penalty on offsets of Gaussians from their anchors beyond two voxels.

    theta(x) x is a hinge: only the part above ``2 * voxel_size`` (the paper's 2 eps) counts.
    """
    if weights.offset_distance_reading == "scaled":
        total = backend.excess(anchors.offsets, anchors.log_offset_scales, 2.0 * voxel_size)
        return total / max(1, anchors.offsets.numel()) if weights.offset_distance_reduction == "mean" else total
    if weights.offset_distance_reading == "raw":
        length = anchors.offsets.abs()
    else:
        length = (anchors.offsets * anchors.log_offset_scales.exp()[:, None]).norm(dim=-1)
    excess = torch.relu(length - 2.0 * voxel_size)
    return excess.mean() if weights.offset_distance_reduction == "mean" else excess.sum()

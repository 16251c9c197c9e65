# SPDX-License-Identifier: Apache-2.0
"""Anchors to Gaussians for a GPU, in shapes that do not depend on the numbers.

Note [Shapes without waiting]
~~~~~~~~~~~~~~~~~~~~~~~~~~~~~
How many anchors a camera sees, and how many of their Gaussians have a positive opacity, is known on the GPU alone. To
gather them the host must wait for that number, and an iteration could not be recorded into a CUDA graph. So what a
camera sees is a mask ``[M]`` here, and all ``M * K`` Gaussians are generated. Those that would not be drawn have
opacity 0 and scale 0: every rasteriser leaves them out, the volume of their scales adds nothing, and no gradient passes
through them. Whoever counts Gaussians counts ``opacities > 0``.
"""

import torch
from torch import Tensor

from structgstream.kernels import reference_anchors
from structgstream.kernels.anchor_types import MLPWeights, StructuredGaussians


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
    """Mask ``[M]`` bool of what ``kernels.reference_anchors.visible_anchors`` lists (Note [Shapes without waiting])."""
    return reference_anchors.seen_anchors(
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
    """Dress the anchors for one camera, see ``kernels.reference_anchors.generate_structured``.

    With a mask ``visible`` ``[M]`` of bool: ``N = M * K`` Gaussians of which those with a positive opacity are the
    reference's, and ``raw_opacities`` ``[M, K]`` that are -1 for anchors out of sight (Note [Shapes without waiting]).
    With indices ``[m]`` of int64: the reference itself.
    """
    if visible.dtype != torch.bool:
        return reference_anchors.generate_structured(
            positions,
            log_offset_scales,
            log_base_scales,
            offsets,
            features,
            mlps,
            camera_center,
            visible,
            distance_input=distance_input,
        )
    count, k = offsets.shape[:2]
    to_anchor = positions - camera_center
    distance = to_anchor.norm(dim=1, keepdim=True).clamp_min(1e-12)
    parts = [features, to_anchor / distance]
    inputs = torch.cat([*parts, distance] if distance_input else parts, dim=1)
    # One product for the three first layers: on a GPU small products cost their launch.
    first, bias = (torch.cat([getattr(head, name) for head in mlps]) for name in ("w1", "b1"))
    hidden = torch.relu(torch.nn.functional.linear(inputs, first, bias))
    opacity, color, covariance = (
        torch.nn.functional.linear(part, head.w2, head.b2)
        for part, head in zip(hidden.split([head.w1.shape[0] for head in mlps], dim=1), mlps, strict=True)
    )
    raw = torch.where(visible[:, None], torch.tanh(opacity), -1.0)  # [M, K]
    drawn = raw > 0
    covariance = covariance.reshape(count, k, 7)
    scales = log_base_scales.exp()[:, None] * torch.sigmoid(covariance[..., :3])
    return StructuredGaussians(
        means=(positions[:, None] + offsets * log_offset_scales.exp()[:, None]).reshape(-1, 3),
        quats=torch.nn.functional.normalize(covariance[..., 3:], dim=2).reshape(-1, 4),
        scales=torch.where(drawn[..., None], scales, 0.0).reshape(-1, 3),
        opacities=torch.where(drawn, raw, 0.0).reshape(-1),
        colors=torch.sigmoid(color).reshape(-1, 3),
        ids=torch.arange(count * k, device=positions.device),
        raw_opacities=raw.detach(),
    )

# SPDX-License-Identifier: Apache-2.0
"""Anchors to Gaussians on a GPU, with shapes that do not depend on data.

Note [Shapes without waiting]
~~~~~~~~~~~~~~~~~~~~~~~~~~~~~
The numbers of anchors in view and of Gaussians with positive opacity are known on the GPU only; to gather these rows
the host would have to synchronise. So all ``M * K`` Gaussians are generated. Those that are not drawn have opacity 0
and scale 0: every rasteriser skips them, they add nothing to the volume, and no gradient passes through them. The
number of Gaussians is therefore the count of ``opacities > 0``.
"""

import torch
from torch import Tensor

from structgstream.cameras import Viewport
from structgstream.gaussians import Gaussians
from structgstream.kernels.anchor_types import Anchors, MLPWeights, StructuredGaussians
from structgstream.kernels.raster_types import TileSelection
from structgstream.kernels.reference_anchors import visible_anchor_mask


def generate_structured(
    anchors: Anchors,
    mlps: MLPWeights,
    viewport: Viewport,
    *,
    distance_input: bool,
    tiles: TileSelection | None = None,
    seen_from: Tensor | None = None,
    sampling_intervals: Tensor | None = None,
) -> StructuredGaussians:
    """See ``kernels.operations.GenerateStructured``: ``N = M * K`` Gaussians of all anchors.

    Those with a positive opacity equal the reference's; ``raw_opacities`` of anchors out of view are -1 (Note [Shapes
    without waiting]).
    """
    positions, log_offset_scales, log_base_scales, offsets, features = anchors
    count, k = offsets.shape[:2]
    seen = visible_anchor_mask(anchors, viewport, tiles, sampling_intervals)
    to_anchor = positions - (viewport.center if seen_from is None else seen_from)
    distance = to_anchor.norm(dim=1, keepdim=True).clamp_min(1e-12)
    parts = [features, to_anchor / distance]
    inputs = torch.cat([*parts, distance] if distance_input else parts, dim=1)
    opacity, color, covariance = head_outputs(mlps, inputs)
    raw = torch.where(seen[:, None], torch.tanh(opacity), -1.0)  # [M, K]
    drawn = raw > 0
    covariance = covariance.reshape(count, k, 7)
    scales = log_base_scales.exp()[:, None] * torch.sigmoid(covariance[..., :3])
    gaussians = Gaussians(
        means=(positions[:, None] + offsets * log_offset_scales.exp()[:, None]).reshape(-1, 3),
        quats=torch.nn.functional.normalize(covariance[..., 3:], dim=2).reshape(-1, 4),
        scales=torch.where(drawn[..., None], scales, 0.0).reshape(-1, 3),
        opacities=torch.where(drawn, raw, 0.0).reshape(-1),
        colors=torch.sigmoid(color).reshape(-1, 3),
        ids=torch.arange(count * k, device=positions.device),
    )
    return StructuredGaussians(gaussians, torch.arange(count, device=positions.device), raw.detach())


def head_outputs(mlps: MLPWeights, inputs: Tensor) -> list[Tensor]:
    """Outputs of each head before activation."""
    # One product for the three first layers, because the cost of small products is their launch.
    first, bias = torch.cat([head.w1 for head in mlps]), torch.cat([head.b1 for head in mlps])
    hidden = torch.relu(torch.nn.functional.linear(inputs, first, bias))
    parts = hidden.split([head.w1.shape[0] for head in mlps], dim=1)
    return [torch.nn.functional.linear(part, head.w2, head.b2) for part, head in zip(parts, mlps, strict=True)]

# SPDX-License-Identifier: Apache-2.0
"""Contribution of each anchor to the training pictures, used to prune anchors that are hardly visible."""

from collections.abc import Sequence

import torch
from torch import Tensor

from structgstream.cameras import Camera
from structgstream.kernels.backend import Backend
from structgstream.scene.scene import Scene


def contributions(scene: Scene, cameras: Sequence[Camera], *, scale: float, backend: Backend) -> Tensor:
    """Blending weights of each anchor's Gaussians, summed over the pixels of all cameras, ``[M]``.

    Relative to the mean over anchors, hence independent of the number and size of the pictures, which are drawn at
    ``scale`` of their width and height.
    """
    anchors = len(scene.anchors)
    total = scene.anchors.positions.new_zeros(anchors)
    for camera in cameras:
        small = camera.resized(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
        generated = scene.structured(small, backend).gaussians
        maps = torch.ones(small.height, small.width, 1, device=total.device)
        weights = backend.blending_weights(generated, small.viewport(generated.means), maps)[:, 0]
        total.index_add_(0, generated.ids // scene.anchors.offsets_per_anchor, weights)
    return total / total.mean().clamp(min=1e-12)

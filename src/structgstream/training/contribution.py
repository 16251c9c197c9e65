# SPDX-License-Identifier: Apache-2.0
"""What each anchor contributes to the training pictures: anchors that hardly show cost time and bytes for nothing."""

from collections.abc import Sequence

import torch
from torch import Tensor

from structgstream.cameras import Camera
from structgstream.kernels.backend import Backend
from structgstream.scene.scene import Scene


def contributions(scene: Scene, cameras: Sequence[Camera], *, scale: float, backend: Backend) -> Tensor:
    """Blending weights of each anchor's Gaussians, summed over the pixels of all cameras, ``[M]``.

    In shares of what an average anchor contributes, so that neither size nor number of the pictures matters: they are
    drawn in ``scale`` of their width and height.
    """
    anchors = len(scene.anchors)
    total = scene.anchors.positions.new_zeros(anchors)
    for camera in cameras:
        small = camera.resized(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
        generated = scene.structured(small, backend).gaussians
        maps = torch.ones(small.height, small.width, 2, device=total.device)
        weights = backend.blending_weights(generated, small.viewport(generated.means), maps)[:, 0]
        total.index_add_(0, generated.ids // scene.anchors.offsets_per_anchor, weights)
    return total / total.mean().clamp(min=1e-12)

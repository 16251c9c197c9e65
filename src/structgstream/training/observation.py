# SPDX-License-Identifier: Apache-2.0
"""Per-mover measurements in the pictures, as sums over pixels by blending weights.

Note [Movers]
~~~~~~~~~~~~~
A mover is a unit of motion: an anchor with its K Gaussians, or a free Gaussian. Movers are numbered anchors first, then
free Gaussians, ``M + F`` in all. A map is gathered for a mover as its sum over the pixels, weighted with the blending
weights of the mover's Gaussians, so that occluded ones get nothing.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from structgstream.cameras import Camera
from structgstream.gaussians import Gaussians, concatenate
from structgstream.kernels.backend import Backend
from structgstream.scene.scene import Scene


@dataclass(frozen=True)
class MotionEvidence:
    """Optical flow of ``E`` movers in each of ``V`` views.

    Args:
        weights: ``[V, E]`` pixels with consistent flow that the mover covers, by blending weight.
        flows: ``[V, E, 2]`` mean flow over them, pixels of the full picture.
        colors: ``[E, 3]`` mean colour of the pictures over the pixels that it covers, in 0 ... 1.
    """

    weights: Tensor
    flows: Tensor
    colors: Tensor

    def select(self, movers: Tensor) -> "MotionEvidence":
        """The evidence of the movers of a mask ``[E]`` or of indices ``[e]``."""
        return MotionEvidence(self.weights[:, movers], self.flows[:, movers], self.colors[movers])


def weigh_maps(
    gaussians: Gaussians, camera: Camera, maps: Tensor, backend: Backend, *, still: Gaussians | None = None
) -> Tensor:
    """Sums of ``maps`` ``[h, w, C]`` over the pixels by blending weight, of each Gaussian: ``[N, C]``.

    Args:
        gaussians: for the camera.
        camera: of the maps' size.
        maps: to sum.
        backend: the compute back-end.
        still: further Gaussians, which only take part in occlusion.
    """
    drawn = gaussians if still is None else concatenate(gaussians, still)
    return backend.blending_weights(drawn, camera.viewport(drawn.means), maps)[: len(gaussians)]


def slot_count(scene: Scene) -> int:
    """Number of ids in a scene (Note [Ids])."""
    return len(scene.anchors) * scene.anchors.offsets_per_anchor + len(scene.free)


def movers_of(gaussians: Gaussians, scene: Scene) -> Tensor:
    """Row ``[N]`` of each Gaussian's mover (Note [Movers])."""
    m, k = len(scene.anchors), scene.anchors.offsets_per_anchor
    return torch.where(gaussians.ids < m * k, gaussians.ids // k, gaussians.ids - m * k + m)


def sum_by_mover(sums: Tensor, movers: Tensor, scene: Scene) -> Tensor:
    """Sums ``[N, C]`` of Gaussians as sums of movers, ``[M + F, C]``; ``movers`` as of :func:`movers_of`."""
    found = sums.new_zeros(len(scene.anchors) + len(scene.free), sums.shape[1])
    return found.index_add_(0, movers, sums)


def flow_evidence(sums: Sequence[Tensor], *, least_pixels: float, most_pixels: float) -> MotionEvidence:
    """Evidence from the gathered sums of the maps c, c flow_x, c flow_y, 1, r, g and b in each view.

    Args:
        sums: by view ``[E, 7]``, in pixels of the full picture.
        least_pixels: fewer pixels of flow get weight 0.
        most_pixels: upper bound of a weight.
    """
    stacked = torch.stack(list(sums))
    weights, moved, coverage, colors = stacked[..., 0], stacked[..., 1:3], stacked[..., 3], stacked[..., 4:]
    flows = moved / weights.clamp(min=1e-6)[..., None]
    weights = torch.where(weights < least_pixels, 0.0, weights.clamp(max=most_pixels))
    return MotionEvidence(weights, flows, colors.sum(0) / coverage.sum(0).clamp(min=1e-6)[:, None])


def mover_centers(scene: Scene, coverage: Tensor) -> Tensor:
    """Visible centre of each mover, ``[M + F, 3]``: the mean of its Gaussians' means, weighted with their coverage.

    Args:
        scene: with the movers.
        coverage: ``[M * K + F]`` pixels, by id.
    """
    anchors, m = scene.anchors, len(scene.anchors) * scene.anchors.offsets_per_anchor
    reach = anchors.offsets * anchors.log_offset_scales.exp()[:, None]
    weights = coverage[:m].reshape(len(anchors), anchors.offsets_per_anchor, 1)
    mean = (reach * weights).sum(1) / weights.sum(1).clamp(min=1e-6)
    return torch.cat([anchors.positions + mean, scene.free.means])

# SPDX-License-Identifier: Apache-2.0
"""Coherent motion: a penalty on anchors that move unlike their neighbours.

Pictures do not show every anchor's motion: along an edge, on a plain surface, or behind another anchor, what is left is
noise, which costs bits, and which shows in views that were not trained on. Neighbours on one body move alike. So
differences of displacement between neighbours are penalised by their length and not its square (like L1), as two
bodies that pass each other differ much at few places.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from structgstream.cameras import Camera
from structgstream.kernels.backend import Backend, on_processor
from structgstream.scene.scene import Scene
from structgstream.training.neighbours import nearest_others, weights_by_distance
from structgstream.training.online.config import SmoothnessConfig
from structgstream.training.parameters import pixel_size


@dataclass(frozen=True)
class MotionSmoothness:
    """Penalty on incoherent motion of ``M`` anchors.

    Args:
        weight: weight in the loss.
        start: ``[M, 3]`` positions from which displacements are counted, scene units.
        neighbours: ``[M, N]`` int64, rows of the anchors that each is compared with.
        shares: ``[M, N]`` their weights, summing to one for each anchor.
        pixel: size of a pixel, scene units.
        slack_pixels: see :class:`SmoothnessConfig`.
    """

    weight: float
    start: Tensor
    neighbours: Tensor
    shares: Tensor
    pixel: float
    slack_pixels: float

    @classmethod
    def of(cls, scene: Scene, cameras: Sequence[Camera], *, config: SmoothnessConfig) -> "MotionSmoothness | None":
        """The penalty on displacements of the anchors of ``scene``; None for none, or if no two are seen.

        Args:
            scene: at the start, usually the dynamic part.
            cameras: of the training views, in scene units.
            config: of the penalty.

        Raises:
            MissingExtraError: SciPy is not installed.
        """
        positions = scene.anchors.positions
        if config.weight == 0.0 or len(positions) < 2:
            return None
        (points,) = on_processor(positions.detach())  # Where neighbours are looked for.
        pixel = pixel_size(points, cameras)
        if pixel is None:
            return None
        rows, distances = (found.to(positions.device) for found in nearest_others(points, config.NEIGHBOURS))
        affinities = weights_by_distance(distances)
        if config.FEATURE_BANDWIDTH > 0.0:
            features = scene.features.detach()
            features = features / features.std(0).clamp(min=1e-6)
            feature_distances = (features[rows] - features[:, None]).square().mean(-1)
            affinities = affinities * torch.exp(-0.5 * feature_distances / config.FEATURE_BANDWIDTH**2)
        shares = affinities / affinities.sum(1, keepdim=True).clamp(min=1e-6)
        return cls(config.weight, positions.detach(), rows, shares, pixel, config.SLACK_PIXELS)

    def difference(self, positions: Tensor, backend: Backend) -> Tensor:
        """Mean difference ``[]`` of the displacements at ``positions`` ``[M, 3]`` from the neighbours', pixels."""
        displacements = (positions - self.start) / self.pixel
        total = backend.neighbour_difference(displacements, self.neighbours, self.shares, slack=self.slack_pixels)
        return total / len(positions)

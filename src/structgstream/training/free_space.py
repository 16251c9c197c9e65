# SPDX-License-Identifier: Apache-2.0
"""Anchors in free space that one or few cameras need and the others see through; they are removed from frame 0.

Note [Free space]
~~~~~~~~~~~~~~~~~
F_alpha sees the direction, so an anchor near one camera can be opaque for that camera alone, and make up for its lens
or its exposure there. From any other place near it, what F_alpha says is chance: a viewer who comes close stands in a
haze. A surface is not like that: few cameras see it in front of what they draw. So an anchor goes if many cameras see
something behind it, and hardly any of them draws it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from structgstream.cameras import Camera
from structgstream.kernels.backend import Backend
from structgstream.scene.scene import Scene

COVERED = 0.5
"""Pixels with less coverage show no surface, so nothing is in front of one there."""


@dataclass(frozen=True)
class FreeSpaceConfig:
    """Removal of anchors in free space (Note [Free space]); not in the paper."""

    enabled: bool = False
    """Remove them after the last iteration (paper: no)."""
    depth_share: float = 0.9
    """An anchor is in front of what a camera draws if its depth is below this share of the drawn depth."""
    least_views: int = 6
    """An anchor is judged only if as many cameras see it in front of what they draw."""
    drawn_share: float = 0.34
    """It is removed if at most this share of them, or a single one, draws one of its Gaussians."""
    drawn_opacity: float = 0.05
    """Opacity above which a Gaussian counts as drawn."""
    scale: float = 0.5
    """Scale of width and height of the pictures in which depth is drawn."""


def in_free_space(scene: Scene, cameras: Sequence[Camera], *, config: FreeSpaceConfig, backend: Backend) -> Tensor:
    """Mask ``[M]`` of the anchors of ``scene`` that float in front of surfaces, as ``cameras`` see it."""
    in_front = scene.anchors.positions.new_zeros(len(scene.anchors))
    drawn = torch.zeros_like(in_front)
    with torch.no_grad():
        for camera in cameras:
            small = camera.resized(*(max(1, round(side * config.scale)) for side in (camera.width, camera.height)))
            structured = scene.structured(small, backend)
            rows = structured.anchors
            before = _before_surfaces(scene.anchors.positions[rows], scene, small, config.depth_share, backend)
            opaque = structured.raw_opacities.amax(1) > config.drawn_opacity
            in_front[rows] += before.to(in_front)
            drawn[rows] += (before & opaque).to(drawn)
    return (in_front >= config.least_views) & (drawn <= (config.drawn_share * in_front).clamp(min=1.0))


def _before_surfaces(points: Tensor, scene: Scene, camera: Camera, share: float, backend: Backend) -> Tensor:
    """Mask ``[n]`` of the points that lie in ``camera``'s picture, nearer than ``share`` of the depth drawn there."""
    viewport = camera.viewport(points)
    depth = _nearest_depth(scene, camera, backend)
    at = points @ viewport.viewmat[:3, :3].T + viewport.viewmat[:3, 3]
    x, y, z = (at @ viewport.K.T).unbind(1)
    column, row = (x / z).floor().long(), (y / z).floor().long()
    inside = (z > viewport.near) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    drawn = depth[row.clamp(0, camera.height - 1), column.clamp(0, camera.width - 1)]
    return inside & (z < share * drawn)


def _nearest_depth(scene: Scene, camera: Camera, backend: Backend) -> Tensor:
    """``[H, W]`` the least drawn depth of 3 x 3 pixels; 0 where one of them shows no surface."""
    gaussians = scene.gaussians(camera, backend)
    viewport = camera.viewport(gaussians.means)
    z = gaussians.means @ viewport.viewmat[2, :3] + viewport.viewmat[2, 3]
    moments = torch.stack([z, torch.ones_like(z), torch.zeros_like(z)], dim=1)
    first, coverage, _ = backend.rasterize(replace(gaussians, colors=moments), viewport).image.unbind(-1)
    depth = torch.where(coverage > COVERED, first / coverage.clamp(min=COVERED), 0.0)
    return -torch.nn.functional.max_pool2d(-depth[None], 3, stride=1, padding=1)[0]

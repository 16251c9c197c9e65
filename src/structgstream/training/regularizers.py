# SPDX-License-Identifier: Apache-2.0
"""Regularizers of frame 0 against Gaussians that are right only in sum; not in the paper.

Three things fit every training view and are wrong in others, most of all on what few cameras see closely: a haze of
faint Gaussians around a surface; layers of light and dark ones that cancel along the training rays; and anchors whose
features have nothing in common with their neighbours'.
"""

from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from structgstream.cameras import Camera
from structgstream.gaussians import Gaussians
from structgstream.kernels.backend import Backend
from structgstream.scene.anchors import AnchorCloud
from structgstream.training.neighbours import nearest_others

SPREAD_EVERY, FEATURES_EVERY = 4, 8
"""Iterations from one evaluation to the next; each counts that many times."""
DEPTH_FROM_SHARE, COLOR_FROM_SHARE = 0.3, 0.1
"""Share of the iterations before the spread of depth and of colour counts, in which surfaces form."""
SCALE = 0.5
"""Scale of width and height of the pictures in which spreads are drawn."""
COVERED = 0.5
"""Rays with less coverage are not counted in the spread of depth."""
NEIGHBORS = 4
"""Number of nearest anchors with which an anchor's features are compared."""


@dataclass(frozen=True)
class RegularizerConfig:
    """Mean weights in the loss per iteration (paper: 0)."""

    depth_spread: float = 0.0
    """Of the standard deviation of depth along a ray, relative to its mean."""
    color_spread: float = 0.0
    """Of the variance of colour along a ray."""
    feature_difference: float = 0.0
    """Of the squared difference of an anchor's features from the mean of its neighbours'."""


@dataclass
class Regularizers:
    """The regularizers of a fit of ``iterations``, and the neighbours of its present anchors."""

    config: RegularizerConfig
    iterations: int
    backend: Backend
    _positions: Tensor | None = field(default=None, init=False)
    _neighbors: Tensor | None = field(default=None, init=False)

    def terms(
        self, iteration: int, gaussians: Gaussians, anchors: AnchorCloud, camera: Camera
    ) -> dict[str, tuple[float, Tensor]]:
        """Weight and value ``[]``, by name, of what counts in ``iteration`` (1, 2, ...).

        Raises:
            MissingExtraError: SciPy is not installed, which features need.
        """
        config, found, share = self.config, dict[str, tuple[float, Tensor]](), iteration / self.iterations
        if iteration % SPREAD_EVERY == 0:
            small = camera.resized(max(1, round(camera.width * SCALE)), max(1, round(camera.height * SCALE)))
            if config.depth_spread and share > DEPTH_FROM_SHARE:
                value = depth_spread(gaussians, small, self.backend)
                found["depth_spread"] = (config.depth_spread * SPREAD_EVERY, value)
            if config.color_spread and share > COLOR_FROM_SHARE:
                value = color_spread(gaussians, small, self.backend)
                found["color_spread"] = (config.color_spread * SPREAD_EVERY, value)
        if config.feature_difference and iteration % FEATURES_EVERY == 0 and len(anchors) > 1:
            value = feature_difference(anchors.features, self._neighbors_of(anchors.positions))
            found["feature_difference"] = (config.feature_difference * FEATURES_EVERY, value)
        return found

    def _neighbors_of(self, positions: Tensor) -> Tensor:
        """Rows ``[M, N]``; positions are fixed in frame 0, and a new tensor after anchors were added or removed."""
        if self._neighbors is None or self._positions is not positions:
            self._positions, self._neighbors = positions, nearest_others(positions, NEIGHBORS)[0]
        return self._neighbors


def depth_spread(gaussians: Gaussians, camera: Camera, backend: Backend) -> Tensor:
    """Relative spread of depth along rays, ``[]`` (compare the distortion loss of Mip-NeRF 360, Barron et al., 2022).

    The standard deviation of depth, weighted by blending weights, relative to the mean depth, averaged over the pixels
    with coverage above :data:`COVERED`. It takes one more rendering, with "colours" z, z^2 and 1.
    """
    viewport = camera.viewport(gaussians.means)
    depths = gaussians.means @ viewport.viewmat[2, :3] + viewport.viewmat[2, 3]
    moments = torch.stack([depths, depths.square(), torch.ones_like(depths)], dim=1)
    image = backend.rasterize(replace(gaussians, colors=moments), viewport).image
    first, second, coverage = image.unbind(-1)
    covered = coverage.detach() > COVERED
    divisor = coverage.clamp(min=COVERED)  # Avoids NaN in pixels that are not counted.
    mean = (first / divisor).clamp(min=camera.near)
    variance = (second / divisor - mean.square()).clamp(min=0.0)
    spread = (variance + 1e-8).sqrt() / mean
    return (spread * covered).sum() / covered.sum().clamp(min=1)


def color_spread(gaussians: Gaussians, camera: Camera, backend: Backend) -> Tensor:
    """Variance of colour along rays, ``[]``: the mean over pixels and channels of the rendered squares of the colours
    minus the square of the rendering, both before black, so that half-covered rays count too.

    It takes two more renderings.
    """
    viewport = camera.viewport(gaussians.means)
    first = backend.rasterize(gaussians, viewport).image
    second = backend.rasterize(replace(gaussians, colors=gaussians.colors.square()), viewport).image
    return torch.relu(second - first.square()).mean()


def feature_difference(features: Tensor, neighbors: Tensor) -> Tensor:
    """Mean squared difference ``[]`` of features ``[M, D]`` from the mean, without gradient, of those of the rows
    ``neighbors`` ``[M, N]``."""
    return (features - features.detach()[neighbors].mean(1)).square().mean()

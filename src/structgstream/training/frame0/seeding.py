# SPDX-License-Identifier: Apache-2.0
"""Where frame 0 starts: anchors at points with random MLPs, the environment, or an earlier period's scene.

Note [Dead outputs]
~~~~~~~~~~~~~~~~~~~
F_alpha has one output for each of an anchor's K Gaussians, shared by all anchors. Only Gaussians of positive opacity
are drawn and get a gradient, as with a ReLU. With random weights about half of the outputs are initially negative for
every anchor, because all features start equal, and an output that no anchor draws stays dead: of K = 5, one to four
survive, depending on the seed. ``all_drawn`` avoids this: a smaller K, with all outputs initially positive. Without it
F_alpha is drawn again while hardly anything would be visible, as with one seed in 400 (K = 5): no Gaussian would ever
get a gradient, and all anchors would be pruned.

Note [Honest coverage]
~~~~~~~~~~~~~~~~~~~~~~
With a black background the optimiser represents dark surfaces by transparency. Coverage then does not distinguish dark
surfaces from unobserved regions, and an environment would shine through dark doors and hair. With a random background
colour in every iteration (``InitialConfig.random_background``) only opaque surfaces can match the pictures, so what
stays transparent is unobserved.
"""

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from structgstream.environment import pixel_directions
from structgstream.errors import CaptureError
from structgstream.harmonics import sh_basis
from structgstream.kernels.backend import Backend
from structgstream.kernels.reference_anchors import head_outputs
from structgstream.kernels.values import HeadWeights, MLPWeights
from structgstream.scene.anchors import AnchorCloud
from structgstream.scene.color import CameraColor
from structgstream.scene.free import FreeGaussians
from structgstream.scene.render import draw
from structgstream.scene.scene import Scene
from structgstream.training.frame0.densify import fresh_cells
from structgstream.training.neighbours import kd_tree, nearest
from structgstream.training.views import View

log = logging.getLogger(__name__)


def voxel_centers(points: Tensor, voxel_size: float) -> Tensor:
    """The centres of the voxels that hold a point: ``unique(round(p / eps)) * eps``, ``[M, 3]``."""
    return (points / voxel_size).round().to(torch.int64).unique(dim=0).to(points) * voxel_size


def neighbor_distances(points: Tensor) -> Tensor:
    """Root of the mean squared distance of each point to its three nearest neighbours, ``[M]``."""
    tree = kd_tree(points)
    distances, _ = tree.query(tree.data, k=min(4, len(points)))
    squared = np.square(np.atleast_2d(distances)[:, 1:]).mean(axis=1)
    return torch.from_numpy(np.sqrt(np.maximum(squared, 1e-7))).to(points)


def random_head(inputs: int, hidden: int, outputs: int, generator: torch.Generator) -> HeadWeights:
    """Random weights as in torch's linear layers: uniform within 1 / sqrt(inputs)."""

    def layer(rows: int, columns: int) -> tuple[Tensor, Tensor]:
        bound = 1.0 / math.sqrt(columns)
        weight = (torch.rand(rows, columns, generator=generator) * 2 - 1) * bound
        return weight, (torch.rand(rows, generator=generator) * 2 - 1) * bound

    return HeadWeights(*layer(hidden, inputs), *layer(outputs, hidden))


MIN_VISIBLE_SHARE = 0.1
"""Least share of the directions from which an untrained anchor has a Gaussian of positive opacity."""


def _visible_share(opacity: HeadWeights, feature_width: int) -> float:
    """Share of the directions, at a distance of 1, from which F_alpha gives an anchor without features a positive
    opacity."""
    index = torch.arange(256) + 0.5
    polar, azimuth = torch.acos(1.0 - index / 128.0), math.pi * (1.0 + 5.0**0.5) * index  # Fibonacci's lattice
    around = torch.stack([polar.sin() * azimuth.cos(), polar.sin() * azimuth.sin(), polar.cos()], dim=1)
    inputs = torch.ones(len(around), opacity.w1.shape[1])
    inputs[:, :feature_width], inputs[:, feature_width : feature_width + 3] = 0.0, around
    return float((head_outputs(opacity, inputs) > 0.0).any(1).float().mean())


def seeded_scene(
    points: Tensor,
    *,
    cameras: int,
    voxel_size: float,
    offsets_per_anchor: int,
    feature_width: int,
    hidden_width: int,
    distance_input: bool,
    device: torch.device,
    generator: torch.Generator,
    all_drawn: bool = False,
) -> Scene:
    """A scene of untrained anchors at ``points`` ``[P, 3]``, normalised units.

    Offsets and features start at zero, both scales at the distance to the neighbours, the MLPs at random (Scaffold-GS).
    With ``all_drawn`` the last layer of F_alpha has no negative weight, so that every Gaussian is initially drawn.

    Raises:
        CaptureError: fewer than four distinct points.
    """
    positions = voxel_centers(points.float(), voxel_size)
    m, k = positions.shape[0], offsets_per_anchor
    if m < 4:
        raise CaptureError(
            f"Only {m} initial points remain at a voxel size of {voxel_size:g}; at least 4 are needed. "
            "Check the poses, or give a capture with more overlap between cameras."
        )
    log_scales = neighbor_distances(positions).log()[:, None].expand(m, 3).contiguous().to(device)
    positions = positions.to(device)
    inputs = feature_width + 3 + int(distance_input)
    heads = [random_head(inputs, hidden_width, width * k, generator) for width in (1, 3, 7)]
    if all_drawn:
        heads[0] = heads[0]._replace(w2=heads[0].w2.abs(), b2=heads[0].b2.abs())
    while _visible_share(heads[0], feature_width) < MIN_VISIBLE_SHARE:
        log.warning("frame 0: with the first weights of F_alpha hardly any Gaussian is visible; they are drawn again")
        heads[0] = random_head(inputs, hidden_width, k, generator)
    opacity, color, covariance = (HeadWeights(*(w.to(device) for w in head)) for head in heads)
    return Scene(
        anchors=AnchorCloud(
            positions=positions,
            log_offset_scales=log_scales,
            log_base_scales=log_scales.clone(),
            offsets=positions.new_zeros(m, k, 3),
            features=positions.new_zeros(m, feature_width),
        ),
        mlps=MLPWeights(opacity=opacity, color=color, covariance=covariance),
        free=FreeGaussians.empty(positions),
        camera_color=CameraColor.identity(cameras, positions),
        distance_input=distance_input,
    )


_STRIDE = 4  # pixels between samples: enough for a few coefficients
_MIN_GAIN = 0.1


@dataclass(frozen=True)
class EnvironmentConfig:
    """The environment behind the scene; needs ``random_background`` (Note [Honest coverage])."""

    enabled: bool = False
    """Whether an environment is fitted (paper: no, black)."""

    DEGREE: ClassVar[int] = 2
    """Degree of the spherical harmonics, 0 to 2."""
    SMOOTHNESS: ClassVar[float] = 1e-3
    """Ridge penalty: for a coefficient of degree l, l (l + 1) times this times the sum of the pixels' weights divided
    by 4 pi, about the diagonal of the normal equations."""
    MIN_WEIGHT: ClassVar[float] = 1e-2
    """Added to a pixel's transparency (1 - coverage) to give its weight, so that covered pixels count a little."""
    STEP: ClassVar[float] = 1 / 256
    """Quantization step of the coefficients with the codec ``compact``, full scale 1."""


def fit_environment(scene: Scene, views: Sequence[View], *, config: EnvironmentConfig, backend: Backend) -> Tensor:
    """Coefficients ``[(degree + 1)^2, 3]`` of the colours in the pictures' directions, by least squares.

    Args:
        scene: frame 0; its coverage determines the pixels' weights, its colour correction the reference colours.
        views: the training pictures.
        config: of the fit.
        backend: the compute back-end.
    """
    count = (config.DEGREE + 1) ** 2
    products = torch.zeros(count, count, dtype=torch.float64)
    targets = torch.zeros(count, 3, dtype=torch.float64)
    total, color = 0.0, scene.camera_color
    for view in views:
        with torch.no_grad():
            alpha = draw(scene.gaussians(view.camera, backend), view.camera, backend).alpha
        rows, columns = (torch.arange(0, size, _STRIDE, device=alpha.device) for size in alpha.shape)
        pixels = (rows[:, None] * alpha.shape[1] + columns).reshape(-1)
        gains, biases = (value[view.index].cpu().double() for value in (color.gains, color.biases))
        colors = (view.image.reshape(-1, 3)[pixels].cpu().double() / 255.0 - biases) / gains.clamp(min=_MIN_GAIN)
        weights = (1.0 - alpha.reshape(-1)[pixels]).cpu().double() + config.MIN_WEIGHT
        if view.mask is not None:
            weights = weights * view.mask.reshape(-1)[pixels].cpu()
        basis = sh_basis(pixel_directions(view.camera, pixels).cpu().double(), config.DEGREE)
        products += (basis * weights[:, None]).T @ basis
        targets += (basis * weights[:, None]).T @ (colors - 0.5)
        total += float(weights.sum())
    degrees = torch.tensor([degree for degree in range(config.DEGREE + 1) for _ in range(2 * degree + 1)])
    ridge = config.SMOOTHNESS * total / (4.0 * torch.pi) * (degrees * (degrees + 1)).double()
    found = torch.linalg.solve(products + ridge.diag(), targets)
    return found.to(scene.anchors.positions)


def warm_start(scene: Scene, *, cell: float) -> Scene:
    """``scene`` with its appearance in the features, its free Gaussians as anchors, and without environment.

    An environment belongs to frame 0's fit, which finds another one. Free Gaussians become one anchor for each cell of
    side ``cell`` (scene units) that has no anchor, with the features of the nearest one.
    """
    scene = scene.with_folded_appearance()
    anchors = scene.anchors
    if len(scene.free):
        anchors = anchors.append(_anchors_of(scene.free, anchors, cell))
    return replace(scene, anchors=anchors, free=FreeGaussians.empty(anchors.positions), environment=None)


def _anchors_of(free: FreeGaussians, anchors: AnchorCloud, cell: float) -> AnchorCloud:
    """An anchor for each cell that free Gaussians are in and no anchors: at their mean, as large as they are."""
    fresh, index, cells = fresh_cells(free.means, anchors.positions, cell)
    count = index.bincount(minlength=len(cells))
    rows = torch.cat([free.means[fresh], free.log_scales[fresh].amax(1, keepdim=True)], dim=1)
    means = rows.new_zeros(len(cells), 4).index_add_(0, index, rows) / count[:, None]
    # A Gaussian is at most as large as the base scale, and half of it on average.
    log_scales = (means[:, 3:] + np.log(2.0)).expand(-1, 3)
    return replace(
        anchors.select(nearest(means[:, :3], anchors.positions, 1)[0][:, 0]),  # with what else an anchor has
        positions=means[:, :3].contiguous(),
        log_offset_scales=log_scales.contiguous(),
        log_base_scales=log_scales.contiguous(),
        offsets=means.new_zeros(len(cells), anchors.offsets_per_anchor, 3),
    )

# SPDX-License-Identifier: Apache-2.0
"""Initialisation of frame 0: anchors from points, random MLPs.

Note [Dead outputs]
~~~~~~~~~~~~~~~~~~~
F_alpha has one output for each of an anchor's K Gaussians, shared by all anchors. Only Gaussians of positive opacity
are drawn and get a gradient, as with a ReLU. With random weights about half of the outputs are initially negative for
every anchor, because all features start equal, and an output that no anchor draws stays dead: of K = 5, one to four
survive, depending on the seed. ``all_drawn`` avoids this: a smaller K, with all outputs initially positive.
"""

import math

import numpy as np
import torch
from torch import Tensor

from structgstream.errors import CaptureError, MissingExtraError
from structgstream.kernels.values import HeadWeights, MLPWeights
from structgstream.scene.anchors import AnchorCloud
from structgstream.scene.color import CameraColor
from structgstream.scene.free import FreeGaussians
from structgstream.scene.scene import Scene


def voxel_centers(points: Tensor, voxel_size: float) -> Tensor:
    """The centres of the voxels that hold a point: ``unique(round(p / eps)) * eps``, ``[M, 3]``."""
    return (points / voxel_size).round().to(torch.int64).unique(dim=0).to(points) * voxel_size


def neighbor_distances(points: Tensor) -> Tensor:
    """Root of the mean squared distance of each point to its three nearest neighbours, ``[M]``."""
    try:
        from scipy.spatial import KDTree
    except ImportError as error:
        raise MissingExtraError("scipy", "capture") from error
    values = points.double().numpy(force=True)
    distances, _ = KDTree(values).query(values, k=min(4, len(values)))
    squared = np.square(np.atleast_2d(distances)[:, 1:]).mean(axis=1)
    return torch.from_numpy(np.sqrt(np.maximum(squared, 1e-7))).to(points)


def random_head(inputs: int, hidden: int, outputs: int, generator: torch.Generator) -> HeadWeights:
    """Random weights as in torch's linear layers: uniform within 1 / sqrt(inputs)."""

    def layer(rows: int, columns: int) -> tuple[Tensor, Tensor]:
        bound = 1.0 / math.sqrt(columns)
        weight = (torch.rand(rows, columns, generator=generator) * 2 - 1) * bound
        return weight, (torch.rand(rows, generator=generator) * 2 - 1) * bound

    return HeadWeights(*layer(hidden, inputs), *layer(outputs, hidden))


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

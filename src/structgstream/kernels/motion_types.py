# SPDX-License-Identifier: Apache-2.0
"""Arguments and results of the operations that initialise a frame's motion and births: ``Lift`` and ``Sweep``."""

from dataclasses import dataclass
from typing import NamedTuple

from torch import Tensor


class ViewFlows(NamedTuple):
    """Optical flow of ``E`` movers (anchors and free Gaussians) in ``V`` views.

    Args:
        weights: ``[V, E]`` W, sum of the mover's blending weights over the pixels with reliable flow.
        flows: ``[V, E, 2]`` f, in a unit of which it is known to one.
        viewmats: ``[V, 4, 4]``.
        Ks: ``[V, 3, 3]``, pixels in that unit.
        near: ``[V]`` distance of the near plane along z.
    """

    weights: Tensor
    flows: Tensor
    viewmats: Tensor
    Ks: Tensor
    near: Tensor


class Neighbors(NamedTuple):
    """The movers whose flow determines each of ``T`` targets.

    Args:
        rows: ``[T, N]`` int64, rows of movers.
        affinities: ``[T, N]`` g, their weights.
    """

    rows: Tensor
    affinities: Tensor


@dataclass(frozen=True)
class Lifted:
    """3D displacements fitted to optical flow.

    Args:
        displacements: ``[T, 3]``.
        inlier_share: ``[T]`` share of the flow's weight that are inliers (``reference_motion.lift``); 0 without flow.
        agreeing_views: ``[T]`` int64, number of views in which more than ``share`` of the weight are inliers.
    """

    displacements: Tensor
    inlier_share: Tensor
    agreeing_views: Tensor


@dataclass(frozen=True)
class SweepView:
    """A view of the plane sweep.

    Args:
        colors: ``[h, w, 3]`` picture, 0 ... 1, colour-corrected so that views are comparable.
        missing: ``[h, w]`` share of a pixel's neighbourhood with new content that the rendering lacks, 0 ... 1.
        depths: ``[h, w]`` rendered depth along z; infinite where nothing is rendered.
        viewmat: ``[4, 4]``.
        K: ``[3, 3]`` for a picture of that size.
        near: distance of the near plane along z.
    """

    colors: Tensor
    missing: Tensor
    depths: Tensor
    viewmat: Tensor
    K: Tensor
    near: float


@dataclass(frozen=True)
class Swept:
    """The best point of each ray.

    Args:
        depths: ``[P]`` along z; 0 for a ray without a valid point.
        costs: ``[P]`` least cost; infinite without a valid point.
    """

    depths: Tensor
    costs: Tensor

# SPDX-License-Identifier: Apache-2.0
"""What the operations take and return that put things in place before a frame's first iteration."""

from dataclasses import dataclass
from typing import NamedTuple

from torch import Tensor


class ViewFlows(NamedTuple):
    """Flow of ``E`` movers in ``V`` views.

    Args:
        weights: ``[V, E]`` W, pixels of flow.
        flows: ``[V, E, 2]`` f, pixels.
        viewmats: ``[V, 4, 4]``.
        Ks: ``[V, 3, 3]`` of the pictures in whose pixels f is.
        near: ``[V]`` distance along z under which a view sees nothing.
    """

    weights: Tensor
    flows: Tensor
    viewmats: Tensor
    Ks: Tensor
    near: Tensor


class Neighbors(NamedTuple):
    """Whose flow each of ``T`` targets follows.

    Args:
        rows: ``[T, N]`` int64, rows of movers.
        affinities: ``[T, N]`` g, how much each counts.
    """

    rows: Tensor
    affinities: Tensor


@dataclass(frozen=True)
class Lifted:
    """Flow as displacements in space.

    Args:
        displacements: ``[T, 3]``.
        inlier_share: ``[T]`` weight of the flow that agrees within 1.5 pixels, against all of it; 0 without any.
        agreeing_views: ``[T]`` int64, views of which more than ``share`` of the flow agrees.
    """

    displacements: Tensor
    inlier_share: Tensor
    agreeing_views: Tensor


@dataclass(frozen=True)
class SweepView:
    """A view that rays are swept through.

    Args:
        colors: ``[h, w, 3]`` of the picture, 0 ... 1, the same surface having one colour in all views.
        missing: ``[h, w]`` how much of the surroundings of a pixel the rendering lacks, 0 ... 1.
        depths: ``[h, w]`` of what is rendered, along z; infinite where nothing is.
        viewmat: ``[4, 4]``.
        K: ``[3, 3]`` of a picture of that size.
        near: nothing lies nearer.
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
        depths: ``[P]`` along z; 0 for a ray without a point.
        costs: ``[P]`` the least; infinite without one.
    """

    depths: Tensor
    costs: Tensor

# SPDX-License-Identifier: Apache-2.0
"""Per-primitive measurements in the pictures, as sums over pixels by blending weights.

Note [Primitives]
~~~~~~~~~~~~~~~~~
A primitive is a unit of motion: an anchor with its K Gaussians, or a free Gaussian. Primitives are numbered anchors
first, then free Gaussians, ``M + F`` in all. A map is accumulated for a primitive as its sum over the pixels, weighted
with the blending weights of the primitive's Gaussians, so that occluded ones get nothing.
"""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from structgstream.kernels.backend import Backend
from structgstream.scene.scene import Scene
from structgstream.training.online.config import MotionConfig
from structgstream.training.online.preprocess import PictureChange
from structgstream.training.residuals import BaselineResidual, residuals
from structgstream.training.views import (
    View,
    area_mean,
    dilated,
    evidence_views,
    in_groups,
    mean_of_counting,
    stacked_masks,
)


@dataclass(frozen=True)
class FlowEvidence:
    """Optical flow of ``E`` primitives in each of ``V`` views.

    Args:
        weights: ``[V, E]`` pixels with consistent flow that the primitive covers, by blending weight.
        flows: ``[V, E, 2]`` mean flow over them, pixels of the full picture.
        colors: ``[E, 3]`` mean colour of the pictures over the pixels that it covers, in 0 ... 1.
    """

    weights: Tensor
    flows: Tensor
    colors: Tensor

    def select(self, primitives: Tensor) -> "FlowEvidence":
        """The evidence of the primitives of a mask ``[E]`` or of indices ``[e]``."""
        return FlowEvidence(self.weights[:, primitives], self.flows[:, primitives], self.colors[primitives])


def slot_count(scene: Scene) -> int:
    """Number of ids in a scene (Note [Ids])."""
    return len(scene.anchors) * scene.anchors.offsets_per_anchor + len(scene.free)


def primitive_sums(sums: Tensor, scene: Scene) -> Tensor:
    """Sums ``[..., slots, C]`` by id as sums of primitives, ``[..., M + F, C]``."""
    m, k = len(scene.anchors), scene.anchors.offsets_per_anchor
    structured, free = sums.split([m * k, len(scene.free)], dim=-2)
    return torch.cat([structured.unflatten(-2, (m, k)).sum(-2), free], dim=-2)


VISIBLE_PIXELS = 0.3
"""A primitive is visible in a view if it covers more pixels than this, summed by blending weight. Outlier tests and
occlusion count the views in which it is; the threshold of its vote is ``MotionConfig.MIN_CHANGED_PIXELS``."""

FLOW_MIN_PIXELS, FLOW_MAX_PIXELS = 0.3, 20.0
"""Bounds of a primitive's flow weight in a view, in pixels of a picture of the reference size: below the first it is 0,
above the second it is clamped."""


def flow_evidence(sums: Sequence[Tensor]) -> FlowEvidence:
    """Evidence from the accumulated maps c, c flow_x, c flow_y, 1, r, g and b of each view.

    Args:
        sums: by view ``[E, 7]``, in pixels of a picture of the reference size.
    """
    stacked = torch.stack(list(sums))
    weights, moved, coverage, colors = stacked[..., 0], stacked[..., 1:3], stacked[..., 3], stacked[..., 4:]
    flows = moved / weights.clamp(min=1e-6)[..., None]
    weights = torch.where(weights < FLOW_MIN_PIXELS, 0.0, weights.clamp(max=FLOW_MAX_PIXELS))
    return FlowEvidence(weights, flows, colors.sum(0) / coverage.sum(0).clamp(min=1e-6)[:, None])


def primitive_centers(scene: Scene, coverage: Tensor) -> Tensor:
    """Visible centre of each primitive, ``[M + F, 3]``: the mean of its Gaussians' means, weighted with their coverage.

    Args:
        scene: with the primitives.
        coverage: ``[M * K + F]`` pixels, by id.
    """
    anchors, m = scene.anchors, len(scene.anchors) * scene.anchors.offsets_per_anchor
    reach = anchors.offsets * anchors.log_offset_scales.exp()[:, None]
    weights = coverage[:m].reshape(len(anchors), anchors.offsets_per_anchor, 1)
    mean = (reach * weights).sum(1) / weights.sum(1).clamp(min=1e-6)
    return torch.cat([anchors.positions + mean, scene.free.means])


@dataclass(frozen=True)
class ViewChange:
    """How one view's picture differs as a whole from what the scene and its last picture show.

    Args:
        changed_share: share of its pixels that changed since the previous frame; None if the camera was absent from it.
        wrong_share: share of its pixels with a residual above frame 0's.
        repeated: whether it is the previous picture once more (``preprocess.PictureChange``).
        shift_pixels: by how much the picture is shifted as a whole, at the reference size; measured only where it is
            needed (``select.outlier_candidates``).
    """

    changed_share: float | None
    wrong_share: float
    repeated: bool
    shift_pixels: float = 0.0


@dataclass(frozen=True)
class ViewMeasurement:
    """What one view shows of a scene's primitives, in pixels of a picture of the reference size.

    Args:
        view: the picture.
        coverage: ``[M * K + F]`` pixels that each Gaussian covers by blending weight, by id (Note [Ids]).
        covered: ``[E]`` pixels that each primitive covers.
        covered_changed: ``[E]`` changed pixels among them; None for a camera that was absent from the previous frame.
        flow_sums: ``[E, 7]`` for :func:`flow_evidence`; None if flow was not estimated.
        changed: mask ``[h, w]`` of the changed pixels, at ``MotionConfig.picture_scale``; None as ``covered_changed``.
        change: of the picture as a whole.
    """

    view: View
    coverage: Tensor
    covered: Tensor
    covered_changed: Tensor | None
    flow_sums: Tensor | None
    changed: Tensor | None
    change: ViewChange


def measure(
    scene: Scene,
    views: Sequence[View],
    changes: Sequence[PictureChange | None],
    *,
    config: MotionConfig,
    backend: Backend,
    baseline: BaselineResidual | None = None,
) -> list[ViewMeasurement]:
    """Draw ``scene`` for each view once, and accumulate changed pixels and flow per primitive.

    A pixel has changed if it differs from the previous picture, or if the rendering's residual there exceeds frame 0's:
    the residual also shows change that is too slow between two frames, and errors that earlier frames left behind.

    Args:
        scene: of the previous frame.
        views: of this frame.
        changes: of each view since the previous frame.
        config: sizes and thresholds.
        backend: the compute back-end.
        baseline: residuals of frame 0, for ``residual_threshold``; None for none.
    """
    folded = scene.with_folded_appearance()

    def kind(given: tuple[View, PictureChange | None]) -> Hashable:
        view, change = given
        new = baseline is None or view.index not in baseline.maps
        return view.image.shape, view.camera.near, change is None, change is None or change.flow is None, new

    with torch.no_grad():
        measured = in_groups(
            list(zip(views, changes, strict=True)),
            kind,
            lambda alike: _measure_views(folded, *zip(*alike), config=config, backend=backend, baseline=baseline),
            device=backend.device,
        )
        shares = torch.stack([of_view.shares for of_view in measured]).tolist()
    return [
        ViewMeasurement(
            view,
            *of_view[:5],
            ViewChange(None if change is None else changed, wrong, repeated=change is not None and change.repeated),
        )
        for view, of_view, (changed, wrong), change in zip(views, measured, shares, changes, strict=True)
    ]


class _Measured(NamedTuple):
    """Fields of :class:`ViewMeasurement`, and shares ``[2]`` of changed and of wrong pixels, still on the device."""

    coverage: Tensor
    covered: Tensor
    covered_changed: Tensor | None
    flow_sums: Tensor | None
    changed: Tensor | None
    shares: Tensor


def _measure_views(
    scene: Scene,
    views: Sequence[View],
    changes: Sequence[PictureChange | None],
    *,
    config: MotionConfig,
    backend: Backend,
    baseline: BaselineResidual | None,
) -> list[_Measured]:
    """Of views of one size, all or none of which have a change, flow and a baseline."""
    small = evidence_views(views, config.picture_scale)
    cameras, masks = [view.camera for view in small], stacked_masks(small)
    gaussians = scene.gaussians_of_views(cameras, backend)
    viewports = [camera.viewport(scene.anchors.positions) for camera in cameras]
    size = (cameras[0].height, cameras[0].width)
    valid = scene.anchors.positions.new_ones(len(views), *size) if masks is None else masks.to(scene.anchors.positions)
    pixel_area, slots = views[0].reference_area / (size[0] * size[1]), slot_count(scene)
    known = [change for change in changes if change is not None]
    if not known:
        sums = pixel_area * backend.weigh_views(gaussians, viewports, valid[..., None], slots=slots)
        covered, none = primitive_sums(sums, scene)[..., 0], valid.new_zeros(2)
        return [_Measured(*of_view, None, None, None, none) for of_view in zip(sums[..., 0], covered, strict=True)]
    everywhere = torch.stack([change.changed for change in known]).to(valid)
    changed = area_mean(everywhere[:, None], size)[:, 0]
    changed_shares = changed.mean((1, 2)) if masks is None else mean_of_counting(everywhere, stacked_masks(views))
    maps = [valid[..., None], (changed * valid)[..., None]]
    flows = [change.flow for change in known if change.flow is not None]
    if flows:
        maps.append(torch.stack(flows))
    backgrounds = scene.backgrounds(cameras)
    drawn, sums = backend.draw_and_weigh_views(
        gaussians, viewports, torch.cat(maps, dim=-1), slots=slots, backgrounds=backgrounds
    )
    wrong_shares = torch.zeros_like(changed_shares)
    if baseline is not None and views[0].index in baseline.maps and config.residual_threshold > 0.0:
        baselines = torch.stack([baseline.maps[view.index] for view in views])
        wrong = residuals(list(drawn), small, scene.camera_color, backend) > config.residual_threshold + baselines
        wrong_shares = mean_of_counting(wrong.to(changed), masks)
        around = torch.maximum(changed, dilated(wrong, 1).to(changed))
        # The pictures had to be drawn first; the few pixels in question are accumulated by themselves.
        beyond = ((around - changed) * valid)[..., None]
        sums[..., 1:2] += backend.weigh_views(gaussians, viewports, beyond, slots=slots)
        changed = around
    sums *= pixel_area
    of_primitives = primitive_sums(sums, scene)
    # The maps are 1, changed, c, c flow_x, c flow_y, r, g and b; flow_evidence wants 1 after the flow.
    flow_sums = of_primitives[..., [2, 3, 4, 0, 5, 6, 7]] if flows else [None] * len(views)
    shares = torch.stack([changed_shares, wrong_shares], dim=1)
    # Copied, as a column alone would keep those of flow, too.
    coverage = sums[..., 0].contiguous()
    columns = coverage, of_primitives[..., 0], of_primitives[..., 1], flow_sums, changed > 0.0, shares
    return [_Measured(*of_view) for of_view in zip(*columns, strict=True)]

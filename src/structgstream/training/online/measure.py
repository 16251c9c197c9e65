# SPDX-License-Identifier: Apache-2.0
"""Per-primitive measurements in the pictures, as sums over pixels by blending weights.

Note [Primitives]
~~~~~~~~~~~~~~~~~
A primitive is a unit of motion: an anchor with its K Gaussians, or a free Gaussian. Primitives are numbered anchors
first, then free Gaussians, ``M + F`` in all. A map is accumulated for a primitive as its sum over the pixels, weighted
with the blending weights of the primitive's Gaussians, so that occluded ones get nothing.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from structgstream.cameras import Camera
from structgstream.gaussians import Gaussians, concatenate
from structgstream.kernels.backend import Backend
from structgstream.scene.scene import Scene
from structgstream.training.online.config import MotionConfig
from structgstream.training.online.preprocess import PictureChange
from structgstream.training.residuals import ResidualFloor, residual
from structgstream.training.views import View, area_mean, mean_of_counting


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


def accumulate(
    gaussians: Gaussians, camera: Camera, maps: Tensor, backend: Backend, *, static: Gaussians | None = None
) -> Tensor:
    """Sums of ``maps`` ``[h, w, C]`` over the pixels by blending weight, of each Gaussian: ``[N, C]``.

    Args:
        gaussians: for the camera.
        camera: of the maps' size.
        maps: to sum.
        backend: the compute back-end.
        static: further Gaussians, which only take part in occlusion.
    """
    drawn = gaussians if static is None else concatenate(gaussians, static)
    return backend.blending_weights(drawn, camera.viewport(drawn.means), maps)[: len(gaussians)]


def slot_count(scene: Scene) -> int:
    """Number of ids in a scene (Note [Ids])."""
    return len(scene.anchors) * scene.anchors.offsets_per_anchor + len(scene.free)


def primitive_of(gaussians: Gaussians, scene: Scene) -> Tensor:
    """Row ``[N]`` of each Gaussian's primitive (Note [Primitives])."""
    m, k = len(scene.anchors), scene.anchors.offsets_per_anchor
    return torch.where(gaussians.ids < m * k, gaussians.ids // k, gaussians.ids - m * k + m)


def sum_by_primitive(sums: Tensor, primitives: Tensor, scene: Scene) -> Tensor:
    """Sums ``[N, C]`` of Gaussians as sums of primitives, ``[M + F, C]``; ``primitives`` as of :func:`primitive_of`."""
    found = sums.new_zeros(len(scene.anchors) + len(scene.free), sums.shape[1])
    return found.index_add_(0, primitives, sums)


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
    floor: ResidualFloor | None = None,
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
        floor: residuals of frame 0, for ``residual_threshold``; None for none.
    """
    with torch.no_grad():
        folded = scene.with_folded_appearance()
        return [
            _measure_view(folded, view, change, config=config, backend=backend, floor=floor)
            for view, change in zip(views, changes, strict=True)
        ]


def _measure_view(
    scene: Scene,
    view: View,
    change: PictureChange | None,
    *,
    config: MotionConfig,
    backend: Backend,
    floor: ResidualFloor | None,
) -> ViewMeasurement:
    small = view.evidence(config.picture_scale)
    gaussians = scene.gaussians(small.camera, backend)
    size = (small.camera.height, small.camera.width)
    valid = torch.ones(size).to(gaussians.means) if small.mask is None else small.mask.to(gaussians.means)
    pixel_area = view.reference_area / valid.numel()
    coverage = gaussians.means.new_zeros(slot_count(scene))
    if change is None:
        sums = pixel_area * accumulate(gaussians, small.camera, valid[..., None], backend)
        coverage[gaussians.ids] = sums[:, 0]
        covered = sum_by_primitive(sums, primitive_of(gaussians, scene), scene)[:, 0]
        absent = ViewChange(None, 0.0, repeated=False)
        return ViewMeasurement(view, coverage, covered, None, None, None, absent)
    changed = area_mean(change.changed[None, None].to(gaussians.means), size)
    changed_share = float(changed.mean() if view.mask is None else mean_of_counting(change.changed.float(), view.mask))
    changed = changed[0, 0]
    maps = [valid[..., None], (changed * valid)[..., None]]
    if change.flow is not None:
        maps.append(change.flow)
    viewport, background = small.camera.viewport(gaussians.means), scene.background(small.camera)
    drawn, sums = backend.picture_and_weights(gaussians, viewport, torch.cat(maps, dim=-1), background=background)
    wrong_share = 0.0
    if floor is not None and view.index in floor.maps and config.residual_threshold > 0.0:
        wrong = residual(drawn, small, scene.camera_color, backend) > config.residual_threshold + floor.maps[view.index]
        wrong = wrong.to(changed)
        wrong_share = float(mean_of_counting(wrong, small.mask))
        around = torch.maximum(changed, max_pool2d(wrong[None, None], 3, stride=1, padding=1)[0, 0])
        # The picture had to be drawn first; the few pixels in question are accumulated by themselves.
        beyond = ((around - changed) * valid)[..., None]
        sums[:, 1:2] += accumulate(gaussians, small.camera, beyond, backend)
        changed = around
    sums *= pixel_area
    coverage[gaussians.ids] = sums[:, 0]
    sums = sum_by_primitive(sums, primitive_of(gaussians, scene), scene)
    return ViewMeasurement(
        view,
        coverage,
        covered=sums[:, 0],
        covered_changed=sums[:, 1],
        flow_sums=None if change.flow is None else sums[:, [2, 3, 4, 0, 5, 6, 7]],
        changed=changed > 0.0,
        change=ViewChange(changed_share, wrong_share, repeated=change.repeated),
    )

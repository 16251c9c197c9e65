# SPDX-License-Identifier: Apache-2.0
"""Which anchors and free Gaussians are dynamic in a frame; only these are trained (not in the paper).

In each view a primitive gets a vote if it covers enough changed pixels, in number and as a share of the pixels that it
covers. Coverage is by blending weight, so occluded Gaussians get no votes. Cameras that were absent from the previous
frame do not vote, and shares are of the views that can.

Note [Outlier views]
~~~~~~~~~~~~~~~~~~~~
Only inlier views vote. A view is an outlier in four cases. Its picture changed, or has large residuals, nearly
everywhere while the median view did not. Or it has many times the large residuals of the median view, as of a camera
that was bumped, whose picture stays right where it shows plain surfaces. Or it has several times them and its picture
is shifted as a whole, as of a bumped camera that shows little else. Or it is the previous one once more while others
changed: the camera is frozen. If most views changed everywhere, motion between the frames cannot be segmented.

The median needs a majority, and two views are left at least: of two views none can be an outlier, and of three none is
taken for frozen, as two of three may show nothing that moves (:func:`unrecognized_faults`).

Note [Occluded anchors]
~~~~~~~~~~~~~~~~~~~~~~~
Up to a fifth of the anchors is shown by no view, or by too few to vote: those within a body, behind its rim, or below
its surface. If they stayed where they are while the body leaves, they would remain as specks in the air as soon as
nothing covers them, and then nothing there changes any more. So they are dynamic where their neighbours are.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from statistics import median

import torch
from torch import Tensor

from structgstream.flow import picture_shift
from structgstream.kernels.backend import Backend, on_processor
from structgstream.scene.render import render, to_8bit_image
from structgstream.scene.scene import Scene
from structgstream.scene.state import Granularity, fields_of, parameters_of
from structgstream.training.neighbours import nearest
from structgstream.training.online.config import MotionConfig
from structgstream.training.online.measure import (
    VISIBLE_PIXELS,
    FlowEvidence,
    ViewChange,
    ViewMeasurement,
    flow_evidence,
    primitive_centers,
)
from structgstream.training.residuals import apply_camera_color
from structgstream.training.views import View, blackened

WHOLE_PICTURE_SHARE = 0.5
"""Share of changed, or wrong, pixels above which a picture counts as changed, or wrong, everywhere."""
MEDIAN_SHARE = 0.25
"""An outlier requires that the median view's share is below this."""
BUMPED_SHARE, BUMPED_TIMES = 0.2, 8.0
"""Least share of wrong pixels of a bumped camera, and least multiple of the median view's."""
SUSPECT_SHARE, SUSPECT_TIMES = 0.02, 3.0
"""Least share of wrong pixels of a view whose shift is looked for, and least multiple of the median view's."""
SHIFTED_PIXELS = 2.5
"""Least shift of a whole picture, in pixels of a picture of the reference size. In basketball's 60 frames it is found
to be 1.5 at most, and 4 or more of pictures that were shifted by 5 and 3 pixels."""
CLEAR_SHIFT = 0.3
"""Least clarity of a shift, 0 to 1 (``flow.picture_shift``); basketball's are 0.53 or more."""
FROZEN_SHARE = 0.005
"""Least share of changed pixels in the median view for a repeated picture to count as frozen; at most one view in
four may be."""

FEW_VIEWS = 3
"""Up to this many views cannot show every fault of one of them."""


@dataclass(frozen=True)
class DynamicSelection:
    """The dynamic primitives of a frame, and what was measured on the way.

    Args:
        anchors: mask ``[M]`` of dynamic anchors, on the processor.
        free: mask ``[F]`` of dynamic free Gaussians, on the processor.
        visible: by index of each inlier view, mask ``[M * K + F]`` (Note [Ids]) of the visible Gaussians.
        inliers: positions of the views that are no outliers (Note [Outlier views]); only their votes count.
        scene_cut: whether most pictures changed everywhere, so that motion cannot be segmented.
        evidence: optical flow of all primitives, if it was estimated.
        views_with_flow: indices of the views with flow.
        centers: ``[M + F, 3]`` visible centres of all primitives, if flow was estimated.
        changed: by index of each inlier view that is compared with an earlier picture, mask ``[h, w]`` of its changed
            pixels at ``MotionConfig.picture_scale``.
        occluded_count: how many of the dynamic anchors are occluded (Note [Occluded anchors]).
    """

    anchors: Tensor
    free: Tensor
    visible: dict[int, Tensor]
    inliers: tuple[int, ...] = ()
    scene_cut: bool = False
    evidence: FlowEvidence | None = None
    views_with_flow: tuple[int, ...] = ()
    centers: Tensor | None = None
    changed: Mapping[int, Tensor] = field(default_factory=dict)
    occluded_count: int = 0

    @property
    def primitives(self) -> Tensor:
        """Indices (Note [Primitives]) of the dynamic ones, ascending; on the processor."""
        return torch.cat([self.anchors, self.free]).nonzero()[:, 0]


def select_dynamic(
    scene: Scene,
    measured: Sequence[ViewMeasurement],
    *,
    config: MotionConfig,
    backend: Backend,
    before_previous: Scene | None = None,
) -> DynamicSelection:
    """The dynamic primitives of ``scene``, by what each view has measured.

    Args:
        scene: of the previous frame.
        measured: by :func:`~structgstream.training.online.measure.measure`, of each view.
        config: thresholds.
        backend: the compute back-end.
        before_previous: the scene two frames before, for ``hysteresis``; None for none.
    """
    anchors = len(scene.anchors)
    scale = torch.ones(anchors + len(scene.free), device=scene.anchors.positions.device)
    if before_previous is not None:
        scale = torch.where(changed_primitives(before_previous, scene), config.hysteresis, scale)

    view_changes = [of_view.change for of_view in measured]
    for number in outlier_candidates(view_changes):
        shift = _shift_pixels(scene, measured[number].view, config, backend)
        view_changes[number] = replace(view_changes[number], shift_pixels=shift)
    inliers = [number for number, good in enumerate(inlier_views(view_changes)) if good]

    used = [measured[number] for number in inliers]
    # No rows come first, because every inlier may be a camera that was absent from the previous frame.
    none = scale.new_zeros(0, 2, len(scale))
    votes = [torch.stack([m.covered, m.covered_changed])[None] for m in used if m.covered_changed is not None]
    covered, covered_changed = torch.cat([none, *votes]).unbind(1)
    moves = covered_changed > config.MIN_CHANGED_PIXELS * scale
    moves &= covered_changed > config.MIN_CHANGED_SHARE * scale * covered
    # From here on masks lie on the processor, where rows are counted without waiting for a GPU.
    positions, dynamic, shown = on_processor(
        scene.anchors.positions,
        moves.sum(0) >= config.MIN_VOTES,
        (covered > VISIBLE_PIXELS).sum(0) >= config.MIN_VOTES,
    )
    occluded = occluded_dynamic(positions, dynamic[:anchors], shown[:anchors], share=config.occluded_share)
    coverage = torch.stack([m.coverage for m in used])

    found = DynamicSelection(
        anchors=dynamic[:anchors] | occluded,
        free=dynamic[anchors:],
        visible=dict(zip((m.view.index for m in used), coverage > VISIBLE_PIXELS, strict=True)),
        inliers=tuple(inliers),
        scene_cut=is_scene_cut(view_changes),
        changed={m.view.index: m.changed for m in used if m.changed is not None},
        occluded_count=int(occluded.sum()),
    )
    with_flow = [(m.view.index, m.flow_sums) for m in used if m.flow_sums is not None]
    if not with_flow or found.scene_cut:
        return found
    views_with_flow, flow_sums = zip(*with_flow, strict=True)
    return replace(
        found,
        evidence=flow_evidence(flow_sums),
        views_with_flow=views_with_flow,
        centers=primitive_centers(scene, coverage.sum(0)),
    )


def changed_primitives(earlier: Scene, scene: Scene) -> Tensor:
    """Mask ``[M + F]``, anchors before free Gaussians, of the primitives that ``earlier`` lacks or has changed."""

    def changed_rows(granularity: Granularity, now: object, then: object) -> Tensor:
        names = [p.attribute for p in parameters_of(fields_of(granularity)) if p.step]
        pairs = [(getattr(now, name), getattr(then, name)) for name in names]
        changes = [one != other for one, other in pairs if one is not None and other is not None]
        return torch.stack([change if change.dim() == 1 else change.any(1) for change in changes]).any(0)

    anchors, births = changed_rows("anchor", scene.anchors, earlier.anchors), scene.free.births
    if not len(births) or not len(earlier.free):
        return torch.cat([anchors, torch.ones_like(births, dtype=torch.bool)])
    before = earlier.free.select(torch.searchsorted(earlier.free.births, births).clamp(max=len(earlier.free) - 1))
    return torch.cat([anchors, (before.births != births) | changed_rows("free", scene.free, before)])


def outlier_candidates(changes: Sequence[ViewChange]) -> list[int]:
    """The views that have several times the wrong pixels of the median view: their shift is worth looking for."""
    least = max(SUSPECT_SHARE, SUSPECT_TIMES * median(c.wrong_share for c in changes))
    return [number for number, change in enumerate(changes) if change.wrong_share > least]


def inlier_views(changes: Sequence[ViewChange]) -> list[bool]:
    """For each view whether it is no outlier. If fewer than two views are left, none counts as an outlier."""
    usual_change, usual_wrong = _usual_change(changes), median(c.wrong_share for c in changes)
    few_repeated = 4 * sum(c.repeated for c in changes) <= len(changes)

    def is_outlier(c: ViewChange) -> bool:
        changed_everywhere = (c.changed_share or 0.0) > WHOLE_PICTURE_SHARE and usual_change < MEDIAN_SHARE
        wrong_everywhere = c.wrong_share > WHOLE_PICTURE_SHARE and usual_wrong < MEDIAN_SHARE
        bumped = c.wrong_share > max(BUMPED_SHARE, BUMPED_TIMES * usual_wrong) or c.shift_pixels > SHIFTED_PIXELS
        frozen = c.repeated and few_repeated and usual_change > FROZEN_SHARE
        return changed_everywhere or wrong_everywhere or bumped or frozen

    found = [not is_outlier(c) for c in changes]
    return found if sum(found) >= 2 else [True] * len(found)


def unrecognized_faults(views: int) -> str | None:
    """A sentence on the faults of cameras that so many training views cannot show; None where they can show all."""
    if views > FEW_VIEWS:
        return None
    fault = "fails, is frozen or was bumped" if views < FEW_VIEWS else "is frozen"
    return f"With {views} training cameras one that {fault} cannot be recognised; that takes {FEW_VIEWS + 1} or more."


def is_scene_cut(changes: Sequence[ViewChange]) -> bool:
    """Whether most pictures changed everywhere, so that motion cannot be segmented."""
    return _usual_change(changes) > WHOLE_PICTURE_SHARE


def _usual_change(changes: Sequence[ViewChange]) -> float:
    """Median share of changed pixels, over the views that know theirs."""
    return median(c.changed_share for c in changes if c.changed_share is not None)


NEIGHBOURS = 8
"""Number of nearest visible anchors that one which too few views see is compared with."""


def occluded_dynamic(positions: Tensor, dynamic: Tensor, shown: Tensor, *, share: float) -> Tensor:
    """Mask ``[M]`` of the anchors that too few views see and of whose nearest visible ones at least ``share`` move.

    Args:
        positions: ``[M, 3]`` scene units.
        dynamic: mask ``[M]`` of the anchors that move by their own votes.
        shown: mask ``[M]`` of the anchors that enough views see to vote; the others are occluded.
        share: 0 to 1; 0: none is.

    Raises:
        MissingExtraError: SciPy is not installed.
    """
    occluded = torch.zeros_like(dynamic)
    unseen, known = (mask.nonzero()[:, 0] for mask in (~dynamic & ~shown, shown))
    if share == 0.0 or not len(unseen) or not dynamic.any() or not len(known):
        return occluded
    near, _ = nearest(positions[unseen], positions[known], NEIGHBOURS)
    occluded[unseen] = dynamic[known[near]].float().mean(1) >= share
    return occluded


def _shift_pixels(scene: Scene, view: View, config: MotionConfig, backend: Backend) -> float:
    """How far the picture is shifted against the rendering of ``scene``, in pixels of a picture of the reference size;
    0 if that is not clear."""
    small, scene = view.evidence(config.picture_scale), scene.with_folded_appearance()
    with torch.no_grad():
        image = render(scene, small.camera, backend).image
    rendered = apply_camera_color(image, scene.camera_color, view.index)
    picture = blackened(small.image, small.mask).cpu().numpy()
    shift, clarity = picture_shift(to_8bit_image(blackened(rendered, small.mask)), picture)
    return shift * view.camera.width / small.camera.width / view.enlargement if clarity > CLEAR_SHIFT else 0.0

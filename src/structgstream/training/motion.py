# SPDX-License-Identifier: Apache-2.0
"""Motion segmentation: only anchors and free Gaussians that cover changed pixels are trained (the change gate).

In each view a mover gets a vote if it covers enough changed pixels, in number and as a share of the pixels that it
covers. Coverage is by blending weight, so occluded Gaussians get no votes. A pixel has changed if it differs from the
previous picture, or if the rendering's residual there exceeds frame 0's: the residual also finds change that is too
slow between two frames, and errors that earlier frames left behind. Cameras that were absent from the previous frame do
not vote, and shares are of the views that can.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from structgstream.errors import ConfigError
from structgstream.flow import picture_shift
from structgstream.kernels.backend import Backend
from structgstream.scene.render import render, to_8bit_image
from structgstream.scene.scene import Scene
from structgstream.scene.state import FieldName, Granularity, fields_of, parameters_of
from structgstream.training.carrying import carried_anchors
from structgstream.training.flow_maps import USUAL_FLOW, FlowConfig
from structgstream.training.observation import (
    MotionEvidence,
    flow_evidence,
    mover_centers,
    movers_of,
    slot_count,
    sum_by_mover,
    weigh_maps,
)
from structgstream.training.picture_change import PictureChange, detect_picture_changes
from structgstream.training.residuals import ResidualFloor, apply_camera_color, residual
from structgstream.training.trust import CLEAR_SHIFT, ViewChange, is_scene_cut, suspects, trusted_views
from structgstream.training.views import View, area_mean, blackened, mean_of_counting


@dataclass(frozen=True)
class MotionConfig:
    """Thresholds of motion segmentation; not in the paper.

    Pixels are those of pictures of the reference size (``cameras.enlargement``).
    """

    enabled: bool = False
    """Train only movers (paper: False, everything is trained)."""
    change_threshold: float = 0.05
    """A pixel has changed if its mean absolute difference to the previous picture over 3 x 3 pixels and the channels
    (full scale 1) exceeds this; above the sensors' noise."""
    residual_threshold: float = 0.0
    """A pixel has also changed if its residual exceeds frame 0's by this (full scale 1). 0: residuals are not used."""
    reach_pixels: int = 3
    """Changed pixels are dilated by this many pixels."""
    least_pixels: float = 0.3
    """Least number of changed pixels, summed by blending weight, that a mover covers in a view to get its vote."""
    least_share: float = 0.3
    """Least share of changed pixels among all that a mover covers in a view to get its vote."""
    least_views: int = 2
    """Least number of votes of a mover that is trained: two, because one view may have changed by noise."""
    least_views_share: float = 0.0
    """Least share of votes among the views that show the mover; above 0 it excludes static surfaces beside a moving
    object, which change in few views."""
    moved_ease: float = 1.0
    """Factor (hysteresis) on the thresholds of pixels and shares for movers that the last frame changed. 1: none."""
    carried_share: float = 0.0
    """An anchor that fewer than ``least_views`` views show is trained if at least this share of its nearest shown ones
    is: it lies in or behind what moves. 0: none."""
    picture_scale: float = 0.25
    """Scale of width and height, relative to the reference size, of the pictures on which coverage is computed."""
    margin_pixels: int = 8
    """Tiles within this many pixels of moving Gaussians are drawn too, so that these get gradients where they move."""
    full_every_frames: int = 0
    """Interval in frames at which everything is trained, to follow slow changes. 0: never."""
    rest_every: int = 1
    """Tiles in which nothing has changed are drawn only every this many times that a view is. 1: always."""
    tiles_around: int = -1
    """Tiles (16 pixels) farther than this many tiles from one in which something has changed are not drawn, though
    moving Gaussians reach them. -1: all are."""
    tiles: bool = True
    """Draw only the tiles that moving Gaussians reach. False: whole pictures, with the same result."""

    def __post_init__(self) -> None:
        if not 0.0 <= self.carried_share <= 1.0:
            raise ConfigError(f"online.motion.carried_share is {self.carried_share:g}; expected a share from 0 to 1.")


SHARED_FIELDS: frozenset[FieldName] = frozenset(fields_of("shared", "camera"))
"""Shared fields are trained only in frames in which everything is, because still anchors depend on them."""
FLOW_LEAST_PIXELS, FLOW_MOST_PIXELS = 0.3, 20.0
"""Bounds of a mover's flow weight in a view, in pixels of a picture of the reference size: below the first it is 0,
above the second it is clamped."""


@dataclass(frozen=True)
class MotionSegmentation:
    """The motion segmentation of a frame.

    Args:
        anchors: mask ``[M]`` of moving anchors.
        free: mask ``[F]`` of moving free Gaussians.
        visible: by index of each trusted view, mask ``[M * K + F]`` (Note [Ids]) of the visible Gaussians.
        trusted: positions of the views that are no outliers (``trust``); only their votes count.
        scene_cut: whether most pictures changed everywhere, so that motion cannot be segmented.
        evidence: optical flow of all movers, if it was estimated.
        views_with_flow: indices of the views with flow.
        centers: ``[M + F, 3]`` visible centres of all movers, if flow was estimated.
        changed: by index of each trusted view that is compared with an earlier picture, mask ``[h, w]`` of its changed
            pixels at ``MotionConfig.picture_scale``.
        carried_count: how many of the moving anchors are hidden and carried along (``training/carrying.py``).
    """

    anchors: Tensor
    free: Tensor
    visible: dict[int, Tensor]
    trusted: tuple[int, ...] = ()
    scene_cut: bool = False
    evidence: MotionEvidence | None = None
    views_with_flow: tuple[int, ...] = ()
    centers: Tensor | None = None
    changed: Mapping[int, Tensor] = field(default_factory=dict)
    carried_count: int = 0

    @property
    def movers(self) -> Tensor:
        """Indices (Note [Movers]) of the moving ones, ascending."""
        return torch.cat([self.anchors, self.free]).nonzero()[:, 0]


def changed_movers(older: Scene, scene: Scene) -> Tensor:
    """Mask ``[M + F]``, anchors before free Gaussians, of the movers that ``older`` lacks or has changed."""

    def changed_rows(granularity: Granularity, now: object, then: object) -> Tensor:
        names = [p.attribute for p in parameters_of(fields_of(granularity)) if p.step]
        pairs = [(getattr(now, name), getattr(then, name)) for name in names]
        changes = [one != other for one, other in pairs if one is not None and other is not None]
        return torch.stack([change if change.dim() == 1 else change.any(1) for change in changes]).any(0)

    anchors = changed_rows("anchor", scene.anchors, older.anchors)
    free = torch.ones_like(scene.free.births, dtype=torch.bool)
    was = torch.isin(scene.free.births, older.free.births)
    now, then = scene.free.select(was), older.free.select(torch.isin(older.free.births, scene.free.births))
    free[was] = changed_rows("free", now, then)
    return torch.cat([anchors, free])


def detect_changes(
    views: Sequence[View],
    before: Sequence[View],
    *,
    config: MotionConfig,
    backend: Backend,
    flow_from: Collection[int] = (),
    flow: FlowConfig = USUAL_FLOW,
) -> list[PictureChange | None]:
    """:func:`~structgstream.training.picture_change.detect_picture_changes` with the values of ``config``."""
    return detect_picture_changes(
        views,
        before,
        threshold=config.change_threshold,
        reach_pixels=config.reach_pixels,
        scale=config.picture_scale,
        backend=backend,
        flow_from=flow_from,
        flow=flow,
    )


def segment_motion(
    scene: Scene,
    views: Sequence[View],
    changes: Sequence[PictureChange | None],
    *,
    config: MotionConfig,
    backend: Backend,
    older: Scene | None = None,
    floor: ResidualFloor | None = None,
) -> MotionSegmentation:
    """Segments the movers of ``scene`` by the changes of the pictures since the previous frame.

    Args:
        scene: of the previous frame.
        views: of this frame.
        changes: of each view since the previous frame (:func:`detect_changes`); a view without one does not vote.
        config: thresholds.
        backend: the compute back-end.
        older: the scene two frames before, for ``moved_ease``; None for none.
        floor: residuals of frame 0, for ``residual_threshold``; None for none.
    """
    anchors, free = len(scene.anchors), len(scene.free)
    ease = torch.ones(anchors + free, device=scene.anchors.positions.device)
    if older is not None:
        ease[changed_movers(older, scene)] = config.moved_ease
    view_evidence: list[_ViewEvidence] = []
    with torch.no_grad():
        folded = scene.with_folded_appearance()
        for view, change in zip(views, changes, strict=True):
            view_evidence.append(
                _view_evidence(folded, view, change, config=config, backend=backend, ease=ease, floor=floor)
            )
    view_changes = [of_view.change for of_view in view_evidence]
    for number in suspects(view_changes):
        shift = _shift_pixels(folded, views[number], config, backend)
        view_changes[number] = replace(view_changes[number], shift_pixels=shift)
    trusted = [number for number, good in enumerate(trusted_views(view_changes)) if good]
    seen, votes = (torch.stack([getattr(view_evidence[n], name) for n in trusted]).sum(0) for name in ("seen", "votes"))
    coverage = torch.stack([view_evidence[n].coverage for n in trusted])
    enough = (votes >= config.least_views) & (votes >= config.least_views_share * ease * seen)
    shown = seen[:anchors] >= config.least_views
    carried = carried_anchors(scene.anchors.positions, enough[:anchors], shown, share=config.carried_share)
    found = MotionSegmentation(
        enough[:anchors] | carried,
        enough[anchors:],
        visible={views[n].index: view_evidence[n].coverage > config.least_pixels for n in trusted},
        trusted=tuple(trusted),
        scene_cut=is_scene_cut(view_changes),
        changed={views[n].index: changed for n in trusted if (changed := view_evidence[n].changed) is not None},
        carried_count=int(carried.sum()),
    )
    views_with_flow = [n for n in trusted if getattr(changes[n], "flow", None) is not None]
    if not views_with_flow or found.scene_cut:
        return found
    evidence = flow_evidence(
        [view_evidence[n].flows for n in views_with_flow], least_pixels=FLOW_LEAST_PIXELS, most_pixels=FLOW_MOST_PIXELS
    )
    centers = mover_centers(scene, coverage.sum(0))
    return replace(
        found, evidence=evidence, views_with_flow=tuple(views[n].index for n in views_with_flow), centers=centers
    )


@dataclass(frozen=True)
class _ViewEvidence:
    """One view's measurements: masks ``[E]`` of visible movers and of votes, coverage by id, flow sums, and the mask
    ``[h, w]`` of changed pixels."""

    seen: Tensor
    votes: Tensor
    coverage: Tensor
    flows: Tensor
    change: ViewChange
    changed: Tensor | None = None


def _shift_pixels(scene: Scene, view: View, config: MotionConfig, backend: Backend) -> float:
    """How far the picture is shifted against the rendering of ``scene``, in pixels of a picture of the reference size;
    0 if that is not clear."""
    small = view.evidence(config.picture_scale)
    rendered = apply_camera_color(render(scene, small.camera, backend).image, scene.camera_color, view.index)
    picture = blackened(small.image, small.mask).cpu().numpy()
    shift, clarity = picture_shift(to_8bit_image(blackened(rendered, small.mask)), picture)
    return shift * view.camera.width / small.camera.width / view.enlargement if clarity > CLEAR_SHIFT else 0.0


def _view_evidence(
    scene: Scene,
    view: View,
    change: PictureChange | None,
    *,
    config: MotionConfig,
    backend: Backend,
    ease: Tensor,
    floor: ResidualFloor | None,
) -> _ViewEvidence:
    small = view.evidence(config.picture_scale)
    gaussians = scene.gaussians(small.camera, backend)
    size = (small.camera.height, small.camera.width)
    counting = torch.ones(size).to(gaussians.means) if small.mask is None else small.mask.to(gaussians.means)
    enlarged = view.reference_area / counting.numel()
    coverage = gaussians.means.new_zeros(slot_count(scene))
    if change is None:
        covered = enlarged * weigh_maps(gaussians, small.camera, counting[..., None], backend)
        coverage[gaussians.ids] = covered[:, 0]
        none = torch.zeros_like(ease, dtype=torch.bool)
        return _ViewEvidence(none, none, coverage, covered, ViewChange(None, 0.0, repeated=False))
    part = area_mean(change.changed[None, None].to(gaussians.means), size)
    difference = float(part.mean() if view.mask is None else mean_of_counting(change.changed.float(), view.mask))
    part = part[0, 0]
    maps = [counting[..., None], (part * counting)[..., None]]
    if change.flow is not None:
        maps.append(change.flow)
    viewport, background = small.camera.viewport(gaussians.means), scene.background(small.camera)
    drawn, sums = backend.picture_and_weights(gaussians, viewport, torch.cat(maps, dim=-1), background=background)
    wrong_share = 0.0
    if floor is not None and view.index in floor.maps and config.residual_threshold > 0.0:
        missing = residual(drawn, small, scene.camera_color, backend)
        wrong = (missing > config.residual_threshold + floor.maps[view.index]).to(part)
        wrong_share = float(mean_of_counting(wrong, small.mask))
        around = max_pool2d(wrong[None, None], 3, stride=1, padding=1)[0, 0]
        beyond = (torch.maximum(part, around) - part) * counting
        # The picture had to be drawn first; the few pixels in question are weighed by themselves.
        sums[:, 1:2] += weigh_maps(gaussians, small.camera, beyond[..., None], backend)
        part = torch.maximum(part, around)
    sums *= enlarged
    coverage[gaussians.ids] = sums[:, 0]
    of_movers = sum_by_mover(sums, movers_of(gaussians, scene), scene)
    total, inside = of_movers[:, 0], of_movers[:, 1]
    return _ViewEvidence(
        seen=total > config.least_pixels,
        votes=(inside > config.least_pixels * ease) & (inside > config.least_share * ease * total),
        coverage=coverage,
        flows=of_movers[:, [2, 3, 4, 0, 5, 6, 7]] if change.flow is not None else total,
        change=ViewChange(difference, wrong_share, repeated=change.repeated),
        changed=part > 0.0,
    )

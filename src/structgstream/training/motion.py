# SPDX-License-Identifier: Apache-2.0
"""What moves: only anchors and free Gaussians whose place in the pictures changed are fitted (design, change gate).

A Gaussian votes in every view that draws it: it may move if it covers changed pixels, and if they are a good part of
what it covers there. Blending weights are used, so what is hidden behind something does not vote. A pixel has changed
when it differs from the last frame's, or when the rendering misses there what frame 0 did not miss: change that is too
slow to be seen between two frames adds up, and what was left behind stays wrong.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from structgstream.kernels.backend import Backend
from structgstream.scene.scene import Scene
from structgstream.scene.state import FieldName, Granularity, fields_of, parameters_of
from structgstream.training.observation import MotionEvidence, flow_evidence, gather_maps, mover_centers, sum_by_mover
from structgstream.training.picture_change import PictureChange, detect_picture_changes
from structgstream.training.residuals import ResidualFloor, rendering_residual
from structgstream.training.trust import ViewChange, is_scene_cut, trusted_views
from structgstream.training.views import View, area_mean


@dataclass(frozen=True)
class MotionConfig:
    """When something counts as moving."""

    enabled: bool = False
    """Fit only what moves. Off, the paper: everything."""
    change_threshold: float = 0.05
    """Mean absolute difference, in 0 ... 1, of 3 x 3 pixels since the last frame; above the sensors' noise."""
    residual_threshold: float = 0.0
    """A pixel has changed too when the rendering misses so much more there than frame 0's did. 0: only differences
    between frames count."""
    reach_pixels: int = 3
    """So far around a changed pixel things may have moved."""
    least_pixels: float = 0.3
    """A Gaussian votes in a view where it covers so many changed pixels, counted by blending weight ..."""
    least_share: float = 0.3
    """... and so large a part of what it covers."""
    least_views: int = 2
    """Votes that let an anchor, or a free Gaussian, move: one picture cannot tell motion from noise."""
    least_views_share: float = 0.0
    """So large a part of the views that show it must vote too: a wall beside which something passes in a few of them
    does not move."""
    moved_ease: float = 1.0
    """What the last frame changed needs only so many times the pixels and the share: what moves comes to rest in more
    than a frame, and what is at the edge of a change does not stutter. 1: no memory."""
    unseen_pixels: float = 0.0
    """Free Gaussians that cover less than this in every view, counted by blending weight, are removed. 0: none."""
    picture_scale: float = 0.25
    """Who covers what is found on pictures of this size."""
    margin_pixels: int = 8
    """Tiles this far around what moves are drawn too, so that it finds its loss where it goes."""
    full_every_frames: int = 0
    """Everything may move in every so many-th frame: changes too slow to be seen add up. 0: never."""
    tiles: bool = True
    """Draw only the tiles that moving Gaussians reach. Off: whole pictures, for the same result at their cost."""


SHARED_FIELDS: frozenset[FieldName] = frozenset(fields_of("shared", "camera"))
"""What all anchors share changes only in frames in which everything may move: what stands still depends on it."""

FLOW_LEAST_PIXELS, FLOW_MOST_PIXELS = 0.3, 20.0
"""Fewer pixels of flow say nothing of a mover, more say no more than so many."""


@dataclass(frozen=True)
class MotionSegmentation:
    """What may move in a frame.

    Args:
        anchors: mask ``[M]``.
        free: mask ``[F]``.
        unseen: mask ``[F]``, apart from ``free``: what no view shows.
        visible: for each trusted view the Gaussians ``[M * K + F]`` (Note [Ids]) that are not hidden there.
        trusted: numbers of the views whose pictures can be believed (``trust``); only they were asked.
        scene_cut: whether everything changed, so that there is no motion to follow.
        evidence: how all movers were seen to move, if that was asked for ...
        views_with_flow: ... and the indices of the views that told of it.
        centers: ``[M + F, 3]`` where all movers are seen, if that was asked for.
    """

    anchors: Tensor
    free: Tensor
    unseen: Tensor
    visible: dict[int, Tensor]
    trusted: tuple[int, ...] = ()
    scene_cut: bool = False
    evidence: MotionEvidence | None = None
    views_with_flow: tuple[int, ...] = ()
    centers: Tensor | None = None

    @property
    def movers(self) -> Tensor:
        """Indices (Note [Movers]) of what may move, ascending."""
        return torch.cat([self.anchors, self.free]).nonzero()[:, 0]


def changed_movers(older: Scene, scene: Scene) -> Tensor:
    """Mask ``[M + F]``, anchors before free Gaussians, of what ``scene`` has otherwise than ``older`` or not at all."""

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
) -> list[PictureChange]:
    """:func:`~structgstream.training.picture_change.detect_picture_changes` as ``config`` asks for them."""
    return detect_picture_changes(
        views,
        before,
        threshold=config.change_threshold,
        reach_pixels=config.reach_pixels,
        scale=config.picture_scale,
        backend=backend,
        flow_from=flow_from,
    )


def segment_motion(
    scene: Scene,
    views: Sequence[View],
    changes: Sequence[PictureChange],
    *,
    config: MotionConfig,
    backend: Backend,
    older: Scene | None = None,
    floor: ResidualFloor | None = None,
) -> MotionSegmentation:
    """What may move between the pictures of the frame before and those of ``views``.

    Args:
        scene: as it was in the frame before.
        views: of the frame.
        changes: of each view since the frame before (:func:`detect_changes`).
        config: what counts as moving.
        backend: what computes.
        older: the scene a frame earlier, for ``moved_ease``; None for none.
        floor: what frame 0 missed, for ``residual_threshold``; None for none.
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
    trusted = [number for number, good in enumerate(trusted_views(view_changes)) if good]
    seen, votes = (torch.stack([getattr(view_evidence[n], name) for n in trusted]).sum(0) for name in ("seen", "votes"))
    coverage = torch.stack([view_evidence[n].coverage for n in trusted])
    enough = (votes >= config.least_views) & (votes >= config.least_views_share * ease * seen)
    unseen = coverage[:, coverage.shape[1] - free :].amax(0) < config.unseen_pixels
    found = MotionSegmentation(
        enough[:anchors],
        enough[anchors:] & ~unseen,
        unseen,
        visible={views[n].index: view_evidence[n].coverage > config.least_pixels for n in trusted},
        trusted=tuple(trusted),
        scene_cut=is_scene_cut(view_changes),
    )
    views_with_flow = [n for n in trusted if changes[n].flow is not None]
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
    """What one view says: whether it sees movers ``[E]`` and votes for them, what each id covers, and flow."""

    seen: Tensor
    votes: Tensor
    coverage: Tensor
    flows: Tensor
    change: ViewChange


def _view_evidence(
    scene: Scene,
    view: View,
    change: PictureChange,
    *,
    config: MotionConfig,
    backend: Backend,
    ease: Tensor,
    floor: ResidualFloor | None,
) -> _ViewEvidence:
    small = view.reduced(config.picture_scale)
    gaussians = scene.gaussians(small.camera, backend)
    size = (small.camera.height, small.camera.width)
    part = area_mean(change.changed[None, None].to(gaussians.means), size)
    difference = float(part.mean())
    wrong_share = 0.0
    if floor is not None and config.residual_threshold > 0.0:
        missing = rendering_residual(gaussians, small, scene, backend)
        wrong = (missing > config.residual_threshold + floor.maps[view.index]).to(part)
        wrong_share = float(wrong.mean())
        part = torch.maximum(part, max_pool2d(wrong[None, None], 3, stride=1, padding=1))
    maps = [torch.ones_like(part[0, 0, :, :, None]), part[0, 0, :, :, None]]
    if change.flow is not None:
        maps.append(change.flow)
    sums = gather_maps(gaussians, scene, small.camera, torch.cat(maps, dim=-1), backend)
    sums *= view.camera.height * view.camera.width / part.numel()
    total, inside = sum_by_mover(sums[:, :2], scene).unbind(1)
    return _ViewEvidence(
        seen=total > config.least_pixels,
        votes=(inside > config.least_pixels * ease) & (inside > config.least_share * ease * total),
        coverage=sums[:, 0],
        flows=sum_by_mover(sums[:, [2, 3, 4, 0, 5, 6, 7]], scene) if change.flow is not None else total,
        change=ViewChange(difference, wrong_share, identical=change.identical),
    )

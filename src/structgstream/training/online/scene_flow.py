# SPDX-License-Identifier: Apache-2.0
"""Initial scene flow: optical flow displaces dynamic primitives before the first iteration (not in the paper).

The gradient of a picture loss leads a Gaussian to its new position only while both overlap in the picture. Optical flow
covers larger displacements, so that fast motion leaves no blur and no ghosts. There are two rounds: flow from the
previous pictures to these, and then, after displacing the primitives (Note [Primitives]), flow from the rendering to
these pictures, which also corrects errors of earlier frames.
"""

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import torch
from torch import Tensor

from structgstream.kernels.backend import Backend
from structgstream.kernels.values import Neighbors, ViewFlows
from structgstream.scene.active_tiles import ActiveTiles
from structgstream.scene.scene import Scene
from structgstream.training.neighbours import nearest
from structgstream.training.online.config import LiftConfig, MotionConfig, SceneFlowConfig
from structgstream.training.online.measure import (
    FlowEvidence,
    accumulate,
    flow_evidence,
    primitive_centers,
    primitive_of,
    slot_count,
    sum_by_primitive,
)
from structgstream.training.online.preprocess import flow_map
from structgstream.training.online.split import DynamicSplit, find_active_tiles
from structgstream.training.residuals import apply_camera_color
from structgstream.training.views import View, as_picture, blackened


@dataclass(frozen=True)
class LiftedFlow:
    """Initial displacements of ``T`` primitives in a frame.

    Args:
        displacements: ``[T, 3]``.
        lifted: mask ``[T]`` of those fitted to flow; the others have their prior.
    """

    displacements: Tensor
    lifted: Tensor


def lift_flow(
    evidence: FlowEvidence,
    centers: Tensor,
    priors: Tensor,
    views: Sequence[View],
    *,
    config: LiftConfig,
    backend: Backend,
) -> LiftedFlow:
    """A displacement for each of ``T`` primitives.

    Args:
        evidence: of these primitives.
        centers: ``[T, 3]`` visible centres.
        priors: ``[T, 3]`` displacements expected without flow.
        views: in the evidence's order; flow is in their pixels.
        config: of the fit.
        backend: the compute back-end.

    Raises:
        MissingExtraError: SciPy is not installed.
    """
    informed = (evidence.weights.amax(0) > 0).nonzero()[:, 0]
    if not len(informed):
        return LiftedFlow(priors, torch.zeros(len(priors), dtype=torch.bool, device=priors.device))
    near, distances = nearest(centers, centers[informed], config.neighbours)
    spread = config.bandwidth * distances[:, -1:].clamp(min=1e-9)
    affinities = torch.exp(-0.5 * (distances / spread).square())
    neighbours = informed[near]
    if config.color_bandwidth > 0.0:
        apart = (evidence.colors[neighbours] - evidence.colors[:, None]).square().sum(-1)
        affinities = affinities * torch.exp(-0.5 * apart / config.color_bandwidth**2)
    viewports = [view.camera.viewport(centers) for view in views]
    # The tolerance has a unit of one pixel at the reference size: errors of the flow of what hardly moves come from how
    # bodies bend, from occlusion and from blending, which are as large in space however many pixels show them.
    noise = centers.new_tensor([view.enlargement for view in views])
    per_noise = torch.stack([1.0 / noise, 1.0 / noise, torch.ones_like(noise)], dim=-1)
    seen = ViewFlows(
        evidence.weights,
        evidence.flows / noise[:, None, None],
        torch.stack([viewport.viewmat for viewport in viewports]),
        torch.stack([viewport.K for viewport in viewports]) * per_noise[..., None],
        centers.new_tensor([viewport.near for viewport in viewports]),
    )
    found = backend.lift(centers, seen, Neighbors(neighbours, affinities), priors, share=config.inlier_share)
    lifted = (found.inlier_share > config.inlier_share) & (found.agreeing_views >= config.agreeing_views)
    displacements = torch.where(lifted[:, None], found.displacements, priors)
    return LiftedFlow(displacements, lifted)


FAST_SHARE = 1 / 80
"""Flow per frame, relative to the longer side of the pictures, above which motion counts as fast: 8 of 640 pixels."""


@dataclass(frozen=True)
class SceneFlow:
    """The initial scene flow of a split's dynamic part.

    Args:
        split: with its dynamic part displaced.
        displacements: ``[M + F, 3]`` of the dynamic part from its last positions.
        active_tiles: by view index, the tiles that it reaches.
        lifted: number of primitives displaced by flow between pictures.
        corrected: number of primitives displaced by flow from the rendering.
        fast: number of primitives whose flow between pictures is larger than :data:`FAST_SHARE`.
        fast_lifted: how many of them are displaced by it; the others are likely to leave ghosts.
    """

    split: DynamicSplit
    displacements: Tensor
    active_tiles: Mapping[int, ActiveTiles]
    lifted: int = 0
    corrected: int = 0
    fast: int = 0
    fast_lifted: int = 0

    @property
    def anchor_displacements(self) -> Tensor:
        """Those of anchors, ``[M, 3]``."""
        return self.displacements[: len(self.split.dynamic.anchors)]

    @property
    def free_displacements(self) -> Tensor:
        """Those of free Gaussians, ``[F, 3]``."""
        return self.displacements[len(self.split.dynamic.anchors) :]

    @property
    def counts(self) -> dict[str, int]:
        """How much of what moves was displaced, for the log."""
        return {
            "displaced": self.lifted,
            "corrected": self.corrected,
            "fast": self.fast,
            "fast displaced": self.fast_lifted,
        }


def apply_scene_flow(
    split: DynamicSplit,
    views: Sequence[View],
    priors: Tensor,
    *,
    config: SceneFlowConfig,
    motion: MotionConfig,
    backend: Backend,
) -> SceneFlow:
    """Displace the dynamic part of ``split`` by optical flow, in up to two rounds; without flow by ``priors``.

    ``M`` anchors and ``F`` free Gaussians are dynamic; displacements are in scene units, anchors before free Gaussians.

    A replacement returns a :class:`SceneFlow`. The optimisation starts from ``split`` shifted by ``displacements``,
    finite ``[M + F, 3]`` on the device of ``split``; one of 0 leaves a primitive at its last position, from which the
    rate term and smoothness count in any case. Spawning draws ``SceneFlow.split``, which is
    ``split.displaced(displacements)``, in ``active_tiles``: :func:`find_active_tiles` of a split that is at most a few
    pixels from that one, with its renderings (here: before the second round; without flow: at the last positions).
    From here on only these tiles are drawn. Nothing but the log depends on the counts.

    Args:
        split: the scene of the previous frame in two parts, and ``split.selection``. If flow was estimated, that has
            ``evidence`` (``[V, E]`` weights, ``[V, E, 2]`` flow in pixels of each view's full picture) and ``centers``
            ``[E, 3]`` of all ``E`` primitives, of which ``selection.primitives`` are the ``M + F`` dynamic ones, and
            ``views_with_flow``, the ``V`` views' indices in order; otherwise ``evidence`` and ``centers`` are None.
        views: inliers of the frame's training views, with pictures ``[H, W, 3]`` uint8 and cameras in scene units.
        priors: ``[M + F, 3]`` displacements expected without flow.
        config: of the scene flow.
        motion: of the selection.
        backend: the compute back-end, on the device of ``split``.

    Raises:
        MissingExtraError: SciPy, or OpenCV for the second round, is not installed.
    """
    selection = split.selection
    if not config.enabled or selection.evidence is None or selection.centers is None or not len(priors):
        moved = split.displaced(priors)
        # Tiles are those that the last positions reach, with a margin for motion.
        return SceneFlow(moved, priors, find_active_tiles(split, views, config=motion, backend=backend))

    dynamic = selection.primitives
    evidence, centers = selection.evidence.select(dynamic), selection.centers[dynamic]
    views_with_flow = [view for view in views if view.index in selection.views_with_flow]
    first = lift_flow(evidence, centers, priors, views_with_flow, config=config.LIFT, backend=backend)
    fast = _is_fast(evidence, views_with_flow)

    moved = split.displaced(first.displacements)
    active_tiles = find_active_tiles(moved, views, config=motion, backend=backend)
    displacements, corrected = first.displacements, 0
    if config.rounds > 1:
        second = residual_flow(
            moved.dynamic, views_with_flow, active_tiles, scale=motion.picture_scale, config=config, backend=backend
        )
        displacements, corrected = displacements + second.displacements, int(second.lifted.sum())
    return SceneFlow(
        split.displaced(displacements),
        displacements,
        active_tiles,
        lifted=int(first.lifted.sum()),
        corrected=corrected,
        fast=int(fast.sum()),
        fast_lifted=int((fast & first.lifted).sum()),
    )


def _is_fast(evidence: FlowEvidence, views: Sequence[View]) -> Tensor:
    """Mask ``[E]`` of the rows of ``evidence`` whose mean flow over the views, as a share of the longer side, exceeds
    :data:`FAST_SHARE`."""
    sides = evidence.flows.new_tensor([max(view.camera.width, view.camera.height) for view in views])
    speeds = evidence.flows.norm(dim=-1) / sides[:, None]
    return (evidence.weights * speeds).sum(0) > FAST_SHARE * evidence.weights.sum(0)


def _last_drawing(active: ActiveTiles, view: View, scene: Scene) -> Tensor:
    """The last drawing of a view as its camera would record it, ``[H, W, 3]`` uint8; the view's picture where nothing
    was drawn."""
    drawn = as_picture(apply_camera_color(active.picture, scene.camera_color, view.index))
    return active.tiles.choose(blackened(drawn, view.mask), view.image)


def residual_flow(
    dynamic: Scene,
    views: Sequence[View],
    active_tiles: Mapping[int, ActiveTiles],
    *,
    scale: float,
    config: SceneFlowConfig,
    backend: Backend,
) -> LiftedFlow:
    """Remaining displacements of the primitives of ``dynamic``, from the flow of its rendering to the pictures.

    Args:
        dynamic: the dynamic part of a scene after the first round.
        views: in which flow is estimated.
        active_tiles: by view index, with up-to-date renderings; views without one are skipped.
        scale: of the pictures on which flow is summed by blending weights.
        config: of the scene flow.
        backend: the compute back-end.
    """
    seen = [view for view in views if view.index in active_tiles]
    folded = dynamic.with_folded_appearance()
    sums, coverage = [], dynamic.anchors.positions.new_zeros(slot_count(dynamic))

    def flow_of(view: View) -> Tensor:
        picture = _last_drawing(active_tiles[view.index], view, dynamic)
        inside, camera = active_tiles[view.index].tiles.pixels(), view.evidence(scale).camera
        inside = inside if view.mask is None else inside & view.mask
        size = (camera.height, camera.width)
        return flow_map(picture, view.image, inside, size, mask=view.mask, config=config.FLOW, backend=backend).maps

    threads = torch.get_num_threads()
    with torch.no_grad(), ThreadPoolExecutor(threads) as pool:
        flows = pool.map(flow_of, seen) if threads > 1 else map(flow_of, seen)
        for view, flow in zip(seen, flows, strict=True):
            active, small = active_tiles[view.index], view.evidence(scale)
            gaussians = folded.gaussians(view.camera, backend)
            counting = torch.ones_like(flow[..., 0]) if small.mask is None else small.mask.to(flow)
            maps = torch.cat([flow, counting[..., None], small.colors], dim=-1)
            found = accumulate(gaussians, small.camera, maps, backend, static=active.static)
            found *= view.reference_area / counting.numel()
            sums.append(sum_by_primitive(found, primitive_of(gaussians, folded), folded))
            coverage[gaussians.ids] += found[:, 3]
    nothing = torch.zeros(len(dynamic.anchors) + len(dynamic.free), 3).to(dynamic.anchors.positions)
    if not seen:
        return LiftedFlow(nothing, torch.zeros(len(nothing), dtype=torch.bool, device=nothing.device))
    evidence = flow_evidence(sums)
    return lift_flow(evidence, primitive_centers(dynamic, coverage), nothing, seen, config=config.LIFT, backend=backend)

# SPDX-License-Identifier: Apache-2.0
"""Motion start: movers are displaced by optical flow before the first iteration.

The gradient of a picture loss only leads a Gaussian to its new position while both overlap in the picture. Optical flow
covers larger displacements, so that fast motion leaves no blur and no ghosts. There are two rounds: flow from the
previous pictures to these, and then, after displacing the movers, flow from the rendering to these pictures, which also
corrects errors of earlier frames.
"""

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from structgstream.kernels.backend import Backend
from structgstream.scene.focus import Focus
from structgstream.scene.scene import Scene
from structgstream.training.flow_maps import FlowConfig, flow_map
from structgstream.training.lifting import LiftConfig, LiftedMotion, lift_motion
from structgstream.training.motion import FLOW_LEAST_PIXELS, FLOW_MOST_PIXELS, MotionConfig
from structgstream.training.observation import (
    MotionEvidence,
    flow_evidence,
    mover_centers,
    movers_of,
    slot_count,
    sum_by_mover,
    weigh_maps,
)
from structgstream.training.partition import Partition, focus_views
from structgstream.training.residuals import apply_camera_color
from structgstream.training.views import View, as_picture, blackened

FAST_SHARE = 1 / 80
"""Flow per frame, relative to the longer side of the pictures, above which motion counts as fast: 8 of 640 pixels."""


@dataclass(frozen=True)
class MotionStartConfig:
    """Initial displacement of movers; not in the paper."""

    enabled: bool = False
    """Displace movers by optical flow (paper: False, everything starts at its last position)."""
    rounds: int = 2
    """1: flow between pictures only; 2: also from the rendering to the pictures."""
    views: int = 12
    """Approximate upper bound of the views in which flow is estimated and what is missing is looked for; of more views
    every second or third, in turn."""
    flow: FlowConfig = FlowConfig()
    """How flow is searched."""
    lift: LiftConfig = field(default_factory=LiftConfig)


def flow_views(views: Sequence[View], frame_index: int, config: MotionStartConfig) -> frozenset[int]:
    """Indices of the views in which flow is estimated in a frame; none if the motion start is disabled."""
    if not config.enabled:
        return frozenset()
    stride = -(-len(views) // max(config.views, 2))
    return frozenset(view.index for n, view in enumerate(views) if n % stride == frame_index % stride)


@dataclass(frozen=True)
class InitialMotion:
    """The motion start of the moving part of a scene.

    Args:
        displacements: ``[M + F, 3]`` of its movers (Note [Movers]) from their last positions.
        focuses: by view index, the focus on the moving part.
        lifted_count: number of movers displaced by flow between pictures.
        corrected_count: number of movers displaced by flow from the rendering.
        fast_count: number of rows of ``displacements`` whose flow between pictures is larger than :data:`FAST_SHARE`.
        fast_lifted_count: how many of them are displaced by it; the others are likely to leave ghosts.
    """

    displacements: Tensor
    focuses: Mapping[int, Focus]
    lifted_count: int = 0
    corrected_count: int = 0
    fast_count: int = 0
    fast_lifted_count: int = 0


def estimate_initial_motion(
    partition: Partition,
    views: Sequence[View],
    priors: Tensor,
    *,
    config: MotionStartConfig,
    motion: MotionConfig,
    backend: Backend,
) -> InitialMotion:
    """The motion start of the moving part of ``partition``.

    Args:
        partition: with the evidence of flow, if the motion start is enabled.
        views: of the frame.
        priors: ``[M + F, 3]`` displacements of the moving part expected without flow.
        config: of the motion start.
        motion: of the motion segmentation.
        backend: the compute back-end.
    """
    segmentation = partition.segmentation
    if not config.enabled or segmentation.evidence is None or segmentation.centers is None or not len(priors):
        return InitialMotion(priors, focus_views(partition, views, config=motion, backend=backend))
    movers = segmentation.movers
    evidence, centers = segmentation.evidence.select(movers), segmentation.centers[movers]
    views_with_flow = [view for view in views if view.index in segmentation.views_with_flow]
    first = lift_motion(evidence, centers, priors, views_with_flow, config=config.lift, backend=backend)
    displacements, lifted, corrections = first.displacements, int(first.lifted.sum()), 0
    fast = _is_fast(evidence, views_with_flow)
    moved = replace(partition, moving=with_displacements(partition.moving, displacements))
    focuses = focus_views(moved, views, config=motion, backend=backend)
    if config.rounds > 1:
        second = residual_motion(
            moved.moving, views_with_flow, focuses, scale=motion.picture_scale, config=config, backend=backend
        )
        displacements, corrections = displacements + second.displacements, int(second.lifted.sum())
    return InitialMotion(displacements, focuses, lifted, corrections, int(fast.sum()), int((fast & first.lifted).sum()))


def _is_fast(evidence: MotionEvidence, views: Sequence[View]) -> Tensor:
    """Mask ``[E]`` of the rows of ``evidence`` whose mean flow over the views, as a share of the longer side, exceeds
    :data:`FAST_SHARE`."""
    sides = evidence.flows.new_tensor([max(view.camera.width, view.camera.height) for view in views])
    speeds = evidence.flows.norm(dim=-1) / sides[:, None]
    return (evidence.weights * speeds).sum(0) > FAST_SHARE * evidence.weights.sum(0)


def with_displacements(scene: Scene, displacements: Tensor) -> Scene:
    """``scene``, its movers (Note [Movers]) shifted by ``[M + F, 3]``."""
    m = len(scene.anchors)
    return replace(
        scene,
        anchors=replace(scene.anchors, positions=scene.anchors.positions + displacements[:m]),
        free=replace(scene.free, means=scene.free.means + displacements[m:]),
    )


def _last_drawing(focus: Focus, view: View, scene: Scene) -> Tensor:
    """The last drawing of a view as its camera would record it, ``[H, W, 3]`` uint8; the view's picture where nothing
    was drawn."""
    drawn = as_picture(apply_camera_color(focus.picture, scene.camera_color, view.index))
    return focus.tiles.choose(blackened(drawn, view.mask), view.image)


def residual_motion(
    moving: Scene,
    views: Sequence[View],
    focuses: Mapping[int, Focus],
    *,
    scale: float,
    config: MotionStartConfig,
    backend: Backend,
) -> LiftedMotion:
    """Remaining displacements of the movers of ``moving``, from the flow of its rendering to the pictures.

    Args:
        moving: the moving part of a scene after the first round.
        views: in which flow is estimated.
        focuses: by view index, with up-to-date renderings; views without one are skipped.
        scale: of the pictures on which flow is summed by blending weights.
        config: of the motion start.
        backend: the compute back-end.
    """
    seen = [view for view in views if view.index in focuses]
    folded = moving.with_folded_appearance()
    sums, coverage = [], moving.anchors.positions.new_zeros(slot_count(moving))

    def flow_of(view: View) -> Tensor:
        picture = _last_drawing(focuses[view.index], view, moving)
        inside, camera = focuses[view.index].tiles.pixels(), view.evidence(scale).camera
        inside = inside if view.mask is None else inside & view.mask
        size = (camera.height, camera.width)
        return flow_map(picture, view.image, inside, size, mask=view.mask, config=config.flow, backend=backend).maps

    threads = torch.get_num_threads()
    with torch.no_grad(), ThreadPoolExecutor(threads) as pool:
        flows = pool.map(flow_of, seen) if threads > 1 else map(flow_of, seen)
        for view, flow in zip(seen, flows, strict=True):
            focus, small = focuses[view.index], view.evidence(scale)
            gaussians = folded.gaussians(view.camera, backend)
            counting = torch.ones_like(flow[..., 0]) if small.mask is None else small.mask.to(flow)
            maps = torch.cat([flow, counting[..., None], small.colors], dim=-1)
            found = weigh_maps(gaussians, small.camera, maps, backend, still=focus.still)
            found *= view.reference_area / counting.numel()
            sums.append(sum_by_mover(found, movers_of(gaussians, folded), folded))
            coverage[gaussians.ids] += found[:, 3]
    nothing = torch.zeros(len(moving.anchors) + len(moving.free), 3).to(moving.anchors.positions)
    if not seen:
        return LiftedMotion(nothing, torch.zeros(len(nothing), dtype=torch.bool, device=nothing.device))
    evidence = flow_evidence(sums, least_pixels=FLOW_LEAST_PIXELS, most_pixels=FLOW_MOST_PIXELS)
    return lift_motion(evidence, mover_centers(moving, coverage), nothing, seen, config=config.lift, backend=backend)

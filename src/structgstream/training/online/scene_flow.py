# SPDX-License-Identifier: Apache-2.0
"""Initial scene flow: optical flow displaces dynamic primitives before the first iteration (not in the paper).

The gradient of a picture loss leads a Gaussian to its new position only while both overlap in the picture. Optical flow
covers larger displacements, so that fast motion leaves no blur and no ghosts. In a first round flow leads from the
previous pictures to these. Where much moves fast a second one follows, after displacing the primitives
(Note [Primitives]): flow from the rendering to these pictures, which also corrects errors of earlier frames.
"""

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import reduce

import torch
from torch import Tensor

from structgstream.kernels.backend import Backend, on_processor
from structgstream.kernels.reference_raster import as_picture
from structgstream.kernels.values import Neighbors, ViewFlows, tile_pixels
from structgstream.scene.active_tiles import ActiveTiles
from structgstream.scene.scene import Scene
from structgstream.training.neighbours import nearest, weights_by_distance
from structgstream.training.online.config import MotionConfig, SceneFlowConfig
from structgstream.training.online.measure import (
    FlowEvidence,
    flow_evidence,
    primitive_centers,
    primitive_sums,
    slot_count,
)
from structgstream.training.online.preprocess import flow_map
from structgstream.training.online.split import DynamicSplit, find_active_tiles
from structgstream.training.residuals import recorded
from structgstream.training.views import View, blackened, by_size, evidence_views, stacked_colors, stacked_masks

NEIGHBOURS = 12
"""Number of nearest primitives, including itself, to whose flow a displacement is fitted."""
COLOR_BANDWIDTH = 0.15
"""Standard deviation of the Gaussian weight of a neighbour by colour difference (full scale 1), which separates
adjacent objects."""
INLIER_SHARE = 0.4
"""Least share of inliers of a valid displacement, over all flow and in each agreeing view."""
AGREEING_VIEWS = 2
"""Least number of agreeing views; otherwise a primitive takes the motion prior."""


@dataclass(frozen=True)
class LiftedFlow:
    """Initial displacements of ``T`` primitives in a frame.

    Args:
        displacements: ``[T, 3]``.
        lifted: mask ``[T]`` of those fitted to flow; the others have their prior.
        fast: mask ``[T]`` of those whose flow exceeds :data:`FAST_SHARE`.
        fast_count: how many these are.
    """

    displacements: Tensor
    lifted: Tensor
    fast: Tensor
    fast_count: int


def lift_flow(
    evidence: FlowEvidence,
    centers: Tensor,
    priors: Tensor,
    views: Sequence[View],
    *,
    backend: Backend,
) -> LiftedFlow:
    """A displacement for each of ``T`` primitives.

    Args:
        evidence: of these primitives.
        centers: ``[T, 3]`` visible centres.
        priors: ``[T, 3]`` displacements expected without flow.
        views: in the evidence's order; flow is in their pixels.
        backend: the compute back-end.

    Raises:
        MissingExtraError: SciPy is not installed.
    """
    fast = _is_fast(evidence, views)
    # Where neighbours are looked for.
    points, informed, fast_here = on_processor(centers, evidence.weights.amax(0) > 0, fast)
    informed = informed.nonzero()[:, 0]
    if not len(informed):
        return LiftedFlow(priors, torch.zeros_like(fast), fast, 0)
    near, distances = nearest(points, points[informed], NEIGHBOURS)
    neighbours, affinities = informed[near].to(centers.device), weights_by_distance(distances.to(centers.device))
    color_distances = (evidence.colors[neighbours] - evidence.colors[:, None]).square().sum(-1)
    affinities = affinities * torch.exp(-0.5 * color_distances / COLOR_BANDWIDTH**2)
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
    found = backend.lift(centers, seen, Neighbors(neighbours, affinities), priors, share=INLIER_SHARE)
    lifted = (found.inlier_share > INLIER_SHARE) & (found.agreeing_views >= AGREEING_VIEWS)
    displacements = torch.where(lifted[:, None], found.displacements, priors)
    return LiftedFlow(displacements, lifted, fast, int(fast_here.sum()))


FAST_SHARE = 1 / 80
"""Flow per frame, relative to the longer side of the pictures, above which motion counts as fast: 8 of 640 pixels."""


COUNTS = ("displaced", "corrected", "fast", "fast displaced")
"""Primitives displaced by flow between pictures; by flow from the rendering; those whose flow between pictures is
larger than :data:`FAST_SHARE`; and of these the ones displaced in either round, as the others are likely to leave
ghosts."""


@dataclass(frozen=True)
class SceneFlow:
    """The initial scene flow of a split's dynamic part.

    Args:
        split: with its dynamic part displaced.
        displacements: ``[M + F, 3]`` of the dynamic part from its last positions.
        active_tiles: by view index, the tiles that it reaches.
        counts: for the log, of primitives (:data:`COUNTS`).
    """

    split: DynamicSplit
    displacements: Tensor
    active_tiles: Mapping[int, ActiveTiles]
    counts: Mapping[str, int]

    @property
    def fast_share(self) -> float:
        """Share of the primitives that move fast."""
        return self.counts["fast"] / max(len(self.displacements), 1)


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
    From here on only these tiles are drawn. Of the counts only ``fast`` matters beside the log: for ``fast_share``.

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
        # Tiles are those that the last positions reach, with a margin for motion.
        active_tiles = find_active_tiles(split, views, config=motion, backend=backend)
        return SceneFlow(split.displaced(priors), priors, active_tiles, dict.fromkeys(COUNTS, 0))

    dynamic = selection.primitives
    evidence, centers = selection.evidence.select(dynamic), selection.centers[dynamic]
    views_with_flow = [view for view in views if view.index in selection.views_with_flow]
    first = lift_flow(evidence, centers, priors, views_with_flow, backend=backend)

    moved = split.displaced(first.displacements)
    active_tiles = find_active_tiles(moved, views, config=motion, backend=backend)
    displacements, corrected = first.displacements, torch.zeros_like(first.lifted)
    if config.rounds > 1 and first.fast_count > config.FEW_FAST * len(priors):
        second = residual_flow(
            moved.dynamic, views_with_flow, active_tiles, scale=motion.picture_scale, backend=backend
        )
        displacements, corrected = displacements + second.displacements, second.lifted
        moved = split.displaced(displacements)
    counts = torch.stack([first.lifted, corrected, first.fast, first.fast & (first.lifted | corrected)]).sum(1).tolist()
    return SceneFlow(moved, displacements, active_tiles, dict(zip(COUNTS, counts, strict=True)))


def _is_fast(evidence: FlowEvidence, views: Sequence[View]) -> Tensor:
    """Mask ``[E]`` of the rows of ``evidence`` whose mean flow over the views, as a share of the longer side, exceeds
    :data:`FAST_SHARE`."""
    sides = evidence.flows.new_tensor([max(view.camera.width, view.camera.height) for view in views])
    speeds = evidence.flows.norm(dim=-1) / sides[:, None]
    return (evidence.weights * speeds).sum(0) > FAST_SHARE * evidence.weights.sum(0)


def _last_drawings(actives: Sequence[ActiveTiles], views: Sequence[View], scene: Scene) -> Tensor:
    """The last drawings of views of one size as their cameras would record them, ``[V, H, W, 3]`` uint8; the views'
    pictures where nothing was drawn."""
    color = scene.camera_color.of_cameras([view.index for view in views])
    drawn = as_picture(recorded(torch.stack([active.picture for active in actives]), color.gains, color.biases))
    inside = tile_pixels([active.tiles for active in actives])[..., None]
    return torch.where(inside, blackened(drawn, stacked_masks(views)), torch.stack([view.image for view in views]))


def residual_flow(
    dynamic: Scene,
    views: Sequence[View],
    active_tiles: Mapping[int, ActiveTiles],
    *,
    scale: float,
    backend: Backend,
) -> LiftedFlow:
    """Remaining displacements of the primitives of ``dynamic``, from the flow of its rendering to the pictures.

    Args:
        dynamic: the dynamic part of a scene after the first round.
        views: in which flow is estimated.
        active_tiles: by view index, with up-to-date renderings; views without one are skipped.
        scale: of the pictures on which flow is summed by blending weights.
        backend: the compute back-end.
    """
    seen = [view for view in views if view.index in active_tiles]
    nothing = torch.zeros(len(dynamic.anchors) + len(dynamic.free), 3).to(dynamic.anchors.positions)
    if not seen:
        none = torch.zeros(len(nothing), dtype=torch.bool, device=nothing.device)
        return LiftedFlow(nothing, none, none, 0)
    folded = dynamic.with_folded_appearance()
    with torch.no_grad():
        found = by_size(
            seen,
            lambda same: _weigh_residual_flow(folded, same, active_tiles, scale=scale, backend=backend),
        )
    evidence = flow_evidence([primitive_sums(of_view, folded) for of_view in found])
    coverage = reduce(torch.add, [of_view[:, 3] for of_view in found])
    return lift_flow(evidence, primitive_centers(dynamic, coverage), nothing, seen, backend=backend)


def _weigh_residual_flow(
    scene: Scene,
    views: Sequence[View],
    active_tiles: Mapping[int, ActiveTiles],
    *,
    scale: float,
    backend: Backend,
) -> Tensor:
    """The maps of :func:`flow_evidence` for views of one size, summed by id: ``[V, slots, 7]``."""
    actives, small = [active_tiles[view.index] for view in views], evidence_views(views, scale)
    cameras, masks, counting = [view.camera for view in small], stacked_masks(small), stacked_masks(views)
    inside = tile_pixels([active.tiles for active in actives])
    inside = inside if counting is None else inside & counting
    pictures = torch.stack([view.image for view in views])
    here = on_processor(
        _last_drawings(actives, views, scene), pictures, inside, *([] if counting is None else [counting])
    )
    size = (cameras[0].height, cameras[0].width)

    def flow_of(drawn: Tensor, picture: Tensor, changed: Tensor, mask: Tensor | None = None) -> Tensor:
        return flow_map(drawn, picture, changed, size, mask=mask, backend=backend).maps

    threads = torch.get_num_threads()
    with ThreadPoolExecutor(threads) as pool:
        flows = torch.stack(list((pool.map if threads > 1 else map)(flow_of, *here))).to(pictures.device)
    valid = torch.ones_like(flows[..., 0]) if masks is None else masks.to(flows)
    sums = backend.weigh_views(
        # Directions are those to the cameras, whose centre does not depend on the size of pictures.
        scene.gaussians_of_views([view.camera for view in views], backend),
        [camera.viewport(flows) for camera in cameras],
        torch.cat([flows, valid[..., None], stacked_colors(small)], dim=-1),
        slots=slot_count(scene),
        static=[active.static for active in actives],
    )
    return sums.mul_(views[0].reference_area / (size[0] * size[1]))

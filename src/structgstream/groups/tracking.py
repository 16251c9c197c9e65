# SPDX-License-Identifier: Apache-2.0
"""Tracking: primitives follow scene flow through every frame, without optimization.

A sequential run follows large motion by its scene flow (``training/online/scene_flow.py``), not by its iterations.
Tracking does only this, at low cost: it uses some of the cameras in turn, only changed tiles, and sums of flow at a
quarter of the size. First, flow from the last pictures to the present ones displaces the primitives. Then
flow from the rendering to the pictures, in some of these cameras, bounds drift, because renderings retain the original
appearance. A few cameras in every frame bound it better than all cameras in every second or third frame. Gaussians are
generated once per camera and frame.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce

import torch
from torch import Tensor

from structgstream.cameras import CameraRig
from structgstream.frames import MultiViewFrame
from structgstream.gaussians import Gaussians
from structgstream.kernels.backend import Backend, on_processor
from structgstream.kernels.reference_raster import as_picture
from structgstream.kernels.values import TileSelection
from structgstream.scene.scene import Scene
from structgstream.training.online.config import MotionConfig
from structgstream.training.online.measure import (
    VISIBLE_PIXELS,
    ViewChange,
    flow_evidence,
    primitive_centers,
    primitive_sums,
    slot_count,
)
from structgstream.training.online.preprocess import PictureChange, detect_changes, flow_map
from structgstream.training.online.scene_flow import lift_flow
from structgstream.training.online.select import inlier_views, occluded_dynamic
from structgstream.training.online.split import with_displacements
from structgstream.training.residuals import apply_camera_color
from structgstream.training.views import View, area_mean, blackened, training_views

FEWEST_HALVED, MAX_CAMERAS = 6, 14
"""A frame uses half of a rig's cameras, or all if half were fewer than the first number; never more than the second."""
PRIOR = 0.7
"""Initial displacement of a primitive, as a share of its last displacement."""
RENDERED_EVERY = 3
"""Flow from the rendering is computed in every n-th of the cameras of a frame, in turn."""


@dataclass(frozen=True)
class TrackConfig:
    """Tracking; not in the paper."""

    cameras: int | None = None
    """Upper bound of the cameras used in a frame, at least 2. Of a larger rig every second, third, ... camera is used,
    in turn. None: half of the cameras (:data:`FEWEST_HALVED`, :data:`MAX_CAMERAS`)."""
    picture_scale: float = 0.25
    """Scale at which coverage is computed, relative to the pictures of the stream."""


@dataclass(frozen=True)
class TrackPictures:
    """Reduced pictures of one frame."""

    index: int  # index of the frame
    views: list[View]  # views of all cameras
    # change since the frame before, with flow, of the cameras in use, by position in views
    changes: Mapping[int, PictureChange] = field(default_factory=dict)

    @property
    def changed_share(self) -> float:
        """Mean share of pixels that changed since the frame before; 0 for the first frame."""
        shares = [float(change.changed.float().mean()) for change in self.changes.values()]
        return sum(shares) / len(shares) if shares else 0.0


@dataclass(frozen=True)
class Tracker:
    """Follows the primitives of a scene."""

    config: TrackConfig  # sizes and cameras
    motion: MotionConfig  # thresholds of the selection, for pictures of the stream
    rig: CameraRig  # rig of the stream, in the units of the scene
    backend: Backend

    def stride(self, cameras: int) -> int:
        """Distance between used cameras in a rig of ``cameras`` cameras: 1 uses all of them."""
        half = -(-cameras // 2)
        usual = min(half if half >= FEWEST_HALVED else cameras, MAX_CAMERAS)
        most = usual if self.config.cameras is None else self.config.cameras
        return -(-cameras // max(most, 2))

    def pictures(self, frame: MultiViewFrame, before: Sequence[View] | None) -> TrackPictures:
        """The reduced pictures of ``frame`` and their change since ``before``; independent of the scene."""
        views = training_views(frame, self.rig, self.backend.device)
        if before is None:
            return TrackPictures(frame.index, views)
        stride = self.stride(len(views))
        chosen = [n for n in range(len(views)) if n % stride == frame.index % stride]
        taken = [views[n] for n in chosen]
        found = detect_changes(
            taken,
            before,
            config=replace(self.motion, picture_scale=self.config.picture_scale),
            backend=self.backend,
            flow_from=[view.index for view in taken],
        )
        changes = {n: change for n, change in zip(chosen, found, strict=True) if change is not None}
        return TrackPictures(frame.index, views, changes)


@dataclass(frozen=True)
class Tracked:
    """The primitives of a scene after a tracked frame."""

    scene: Scene  # the displaced scene
    velocities: Tensor  # [M + F, 3] displacements by the last frame

    @classmethod
    def at_rest(cls, scene: Scene) -> "Tracked":
        """A scene without a frame before: velocities are zero."""
        return cls(scene, torch.zeros(len(scene.anchors) + len(scene.free), 3).to(scene.anchors.positions))


def track_frame(tracker: Tracker, past: Tracked, pictures: TrackPictures) -> Tracked:
    """Displace the primitives of ``past`` to the next frame."""
    velocities = torch.zeros_like(past.velocities)
    scene = past.scene.with_folded_appearance()
    with torch.no_grad():
        seen = [_measure_view(tracker, scene, pictures.views[n], change) for n, change in pictures.changes.items()]
        inliers = inlier_views([entry.change for entry in seen]) if seen else []
        seen = [entry for entry, good in zip(seen, inliers, strict=True) if good]
        if not seen:
            return Tracked(past.scene, velocities)
        votes = torch.stack([entry.votes for entry in seen]).sum(0)
        # A moving primitive stays dynamic with a single vote, because not all cameras are used in each frame.
        continued = (past.velocities != 0).any(1) & (votes > 0)
        moving = (votes >= tracker.motion.MIN_VOTES) | continued
        moving[: len(scene.anchors)] |= _occluded(tracker.motion, scene, seen, moving[: len(scene.anchors)])
        primitives = moving.nonzero()[:, 0]
        views = [entry.view for entry in seen]
        evidence = flow_evidence([entry.flows[primitives] for entry in seen])
        centers = primitive_centers(scene, reduce(torch.add, [entry.coverage for entry in seen]))
        priors = PRIOR * past.velocities[primitives]
        found = lift_flow(evidence, centers[primitives], priors, views, backend=tracker.backend)
        velocities[primitives] = found.displacements
        if len(primitives):
            turn = pictures.index // tracker.stride(len(pictures.views))
            part = [entry for n, entry in enumerate(seen) if (n + turn) % RENDERED_EVERY == 0] or seen
            flows = [_rendered_flow(tracker, scene, entry, velocities)[primitives] for entry in part]
            again = lift_flow(
                flow_evidence(flows),
                (centers + velocities)[primitives],
                torch.zeros_like(priors),
                [entry.view for entry in part],
                backend=tracker.backend,
            )
            velocities[primitives] += again.displacements
    return Tracked(with_displacements(past.scene, velocities), velocities)


@dataclass(frozen=True)
class _ViewEvidence:
    """Measurements of one camera: its ``N`` Gaussians in changed tiles and their primitives, coverage by Gaussian id
    ``[M * K + F]``, and votes ``[E]`` and sums of flow ``[E, 7]`` of the ``E`` primitives."""

    view: View
    tiles: TileSelection
    gaussians: Gaussians
    primitives: Tensor
    votes: Tensor
    coverage: Tensor
    flows: Tensor
    change: ViewChange


def _measure_view(tracker: Tracker, scene: Scene, view: View, change: PictureChange) -> _ViewEvidence:
    backend, motion = tracker.backend, tracker.motion
    tiles = TileSelection.of(change.changed)
    gaussians = scene.with_free_gaussians(scene.structured(view.camera, backend, tiles=tiles))
    small = view.evidence(tracker.config.picture_scale)
    size = (small.camera.height, small.camera.width)
    inside = area_mean(_counted_pixels(tiles, view)[None, None].float(), size)[0, 0]
    part = area_mean(change.changed[None, None].float(), size)[0, 0]
    assert change.flow is not None, "flow is estimated for every camera in use"
    # Channels in the order of the evidence, then the changed part. Outside the tiles all are zero and cost nothing.
    colors = change.flow[..., 3:] * inside[..., None]
    maps = torch.cat([change.flow[..., :3], inside[..., None], colors, part[..., None]], dim=-1)
    sums = _weighed(tracker, scene, gaussians, view, maps)
    moved = primitive_sums(sums, scene)
    total, changed = moved[:, 3], moved[:, 7]
    votes = (changed > motion.MIN_CHANGED_PIXELS) & (changed > motion.MIN_CHANGED_SHARE * total)
    of_view = ViewChange(float(change.changed.float().mean()), 0.0, repeated=change.repeated)
    primitives = _primitives_of(gaussians, scene)
    return _ViewEvidence(view, tiles, gaussians, primitives, votes, sums[:, 3].clone(), moved[:, :7], of_view)


def _primitives_of(gaussians: Gaussians, scene: Scene) -> Tensor:
    """Row ``[N]`` of each Gaussian's primitive (Note [Primitives])."""
    m, k = len(scene.anchors), scene.anchors.offsets_per_anchor
    return torch.where(gaussians.ids < m * k, gaussians.ids // k, gaussians.ids - m * k + m)


def _weighed(tracker: Tracker, scene: Scene, gaussians: Gaussians, view: View, maps: Tensor) -> Tensor:
    """Sums ``[M * K + F, C]`` of ``maps`` ``[h, w, C]`` of the reduced ``view`` by Gaussian id, in pixels of the
    stream's pictures at the reference size, the unit of thresholds."""
    camera = view.evidence(tracker.config.picture_scale).camera
    found = tracker.backend.weigh_views([gaussians], [camera.viewport(maps)], maps[None], slots=slot_count(scene))[0]
    return found.mul_(view.reference_area / (camera.height * camera.width))


def _occluded(motion: MotionConfig, scene: Scene, seen: Sequence[_ViewEvidence], moving: Tensor) -> Tensor:
    """Mask ``[M]`` of the anchors that are occluded in changed tiles and whose neighbours are dynamic by votes
    (``moving`` ``[M]``).

    Anchors outside these tiles are neither selected nor used as neighbours, because nothing is measured there.
    """
    anchors, occluded = len(moving), torch.zeros_like(moving)
    drawn, shown = (torch.zeros_like(moving, dtype=torch.int32) for _ in range(2))
    for entry in seen:
        of_view = torch.zeros(len(entry.votes), dtype=torch.bool, device=moving.device)
        of_view[entry.primitives] = True
        drawn += of_view[:anchors]
        shown += entry.flows[:anchors, 3] > VISIBLE_PIXELS
    among = ((drawn >= motion.MIN_VOTES) | (shown >= motion.MIN_VOTES)).nonzero()[:, 0]
    occluded[among] = occluded_dynamic(
        scene.anchors.positions[among], moving[among], shown[among] >= motion.MIN_VOTES, share=motion.occluded_share
    )
    return occluded


def _rendered_flow(tracker: Tracker, scene: Scene, seen: _ViewEvidence, velocities: Tensor) -> Tensor:
    """Sums ``[E, 7]`` of the flow from the rendering of the displaced primitives to the picture."""
    view, backend, gaussians = seen.view, tracker.backend, seen.gaussians
    moved = replace(gaussians, means=gaussians.means + velocities[seen.primitives])
    drawn = backend.rasterize(
        moved, view.camera.viewport(moved.means), background=scene.background(view.camera), tiles=seen.tiles
    )
    image = apply_camera_color(drawn.image, scene.camera_color, view.index)
    counting = _counted_pixels(seen.tiles, view)
    # Nothing is rendered outside the tiles: there the picture replaces the rendering.
    rendered = as_picture(image)
    picture = seen.tiles.choose(blackened(rendered, view.mask), view.image)
    small = view.evidence(tracker.config.picture_scale)
    size = (small.camera.height, small.camera.width)
    first, second, counted = on_processor(picture, view.image, counting)  # Where flow is searched.
    found = flow_map(first, second, counted, size, mask=counted, backend=backend)
    inside = area_mean(counting[None, None].float(), size)[0, 0]
    maps = torch.cat([found.maps.to(inside.device), inside[..., None], small.colors * inside[..., None]], dim=-1)
    return primitive_sums(_weighed(tracker, scene, moved, view, maps), scene)


def _counted_pixels(tiles: TileSelection, view: View) -> Tensor:
    """Mask ``[H, W]`` of the pixels in the tiles and in the view's mask."""
    return tiles.pixels() if view.mask is None else tiles.pixels() & view.mask

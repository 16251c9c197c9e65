# SPDX-License-Identifier: Apache-2.0
"""Tracking: movers follow lifted flow through every frame, without an iteration.

What carries a sequential run through large motion is its motion start (``motion_start``), not its iterations. Tracking
is that alone, on reduced pictures of some of the cameras: the change gate, flow from the last pictures to these, and
flow from the rendering to these, which bounds drift, because renderings do not forget what things look like.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from structgstream.cameras import CameraRig
from structgstream.frames import MultiViewFrame
from structgstream.kernels.backend import Backend
from structgstream.scene.scene import Scene
from structgstream.training.motion import MotionConfig, detect_changes, segment_motion
from structgstream.training.motion_start import MotionStartConfig, estimate_initial_motion, with_displacements
from structgstream.training.partition import Partition
from structgstream.training.picture_change import PictureChange
from structgstream.training.residuals import ResidualFloor
from structgstream.training.stopwatch import Stopwatch
from structgstream.training.views import View, reduced, training_views


@dataclass(frozen=True)
class TrackConfig:
    """Tracking; not in the paper."""

    scale: float = 0.5
    """Size of the pictures relative to those of the stream."""
    cameras: int = 12
    """Largest number of cameras, chosen to be far from each other."""
    picture_scale: float = 0.5
    """Scale, relative to these pictures, at which coverage is computed."""
    prior: float = 0.7
    """Movers are initially displaced by this share of their last displacement."""


def spread_cameras(rig: CameraRig, count: int) -> tuple[str, ...]:
    """``count`` (or all) training cameras of ``rig`` in its order, each next one the farthest from those before it."""
    names = rig.training
    centers = torch.stack([rig[name].center for name in names])
    chosen = [int((centers - centers.mean(0)).norm(dim=1).argmin())]
    distances = (centers - centers[chosen[0]]).norm(dim=1)
    while len(chosen) < min(count, len(names)):
        chosen.append(int(distances.argmax()))
        distances = torch.minimum(distances, (centers - centers[chosen[-1]]).norm(dim=1))
    return tuple(names[row] for row in sorted(chosen))


@dataclass(frozen=True)
class TrackPictures:
    """Reduced pictures of one frame.

    Args:
        views: of the cameras that are tracked with.
        changes: of each since the frame before, with flow; None without one.
    """

    views: list[View]
    changes: list[PictureChange | None] | None

    @property
    def changed_share(self) -> float:
        """Mean share of pixels that changed since the frame before; 0 without one."""
        shares = [float(change.changed.float().mean()) for change in self.changes or () if change is not None]
        return sum(shares) / len(shares) if shares else 0.0


@dataclass(frozen=True)
class Tracker:
    """Follows the movers of a scene; all pictures are reduced.

    Args:
        motion: thresholds of the change gate.
        start: of the motion start.
        prior: share of the last displacement that is expected again.
        rig: of the stream, in the units of the scene.
        backend: the compute back-end.
    """

    motion: MotionConfig
    start: MotionStartConfig
    prior: float
    scale: float
    rig: CameraRig
    backend: Backend

    @classmethod
    def of(
        cls, config: TrackConfig, motion: MotionConfig, start: MotionStartConfig, *, rig: CameraRig, backend: Backend
    ) -> "Tracker":
        """A tracker with the thresholds of a stream's online frames, for ``config.cameras`` of its cameras."""
        # Distances in pixels and sums of pixels are of the stream's pictures, so that they shrink with these.
        reach = max(1, round(motion.reach_pixels * config.scale))
        gate = replace(
            motion,
            picture_scale=config.picture_scale,
            reach_pixels=reach,
            margin_pixels=max(4, round(motion.margin_pixels * config.scale)),
            least_pixels=motion.least_pixels * config.scale**2,
            moved_ease=1.0,
        )
        return cls(gate, replace(start, views=config.cameras), config.prior, config.scale, rig, backend)

    def views(self, frame: MultiViewFrame) -> list[View]:
        """The reduced pictures of ``frame``."""
        return [reduced(view, self.scale) for view in training_views(frame, self.rig, self.backend.device)]

    def pictures(self, frame: MultiViewFrame, before: Sequence[View]) -> TrackPictures:
        """The reduced pictures of ``frame`` and what changed since those before, independent of the scene."""
        views = self.views(frame)
        every = {view.index for view in views}
        changes = detect_changes(views, before, config=self.motion, backend=self.backend, flow_from=every)
        return TrackPictures(views, changes)


@dataclass(frozen=True)
class Tracked:
    """Where the movers of a scene are.

    Args:
        scene: moved.
        velocities: ``[M + F, 3]`` displacements by the last frame.
        seconds: wall-clock seconds by stage of the last frame.
        moved: number of movers in the last frame.
    """

    scene: Scene
    velocities: Tensor
    seconds: Mapping[str, float] = field(default_factory=dict)
    moved: int = 0

    @classmethod
    def at_rest(cls, scene: Scene) -> "Tracked":
        """A scene that nothing is known of before."""
        return cls(scene, torch.zeros(len(scene.anchors) + len(scene.free), 3).to(scene.anchors.positions))


def track_frame(tracker: Tracker, past: Tracked, pictures: TrackPictures, floor: ResidualFloor | None) -> Tracked:
    """Where the movers of ``past`` are one frame later.

    Args:
        tracker: thresholds and cameras.
        past: one frame before.
        pictures: of this frame.
        floor: residuals of frame 0 in such pictures, for ``motion.residual_threshold``.
    """
    assert pictures.changes is not None, "frames after the first have a frame before"
    watch, backend = Stopwatch(tracker.backend.device), tracker.backend
    with watch.stage("find motion"):
        found = segment_motion(
            past.scene, pictures.views, pictures.changes, config=tracker.motion, backend=backend, floor=floor
        )
        partition = Partition.of(past.scene, found)
        trusted = [pictures.views[number] for number in found.trusted]
    with watch.stage("start motion"):
        start = estimate_initial_motion(
            partition,
            trusted,
            tracker.prior * past.velocities[found.movers],
            config=tracker.start,
            motion=tracker.motion,
            backend=backend,
        )
    velocities = torch.zeros_like(past.velocities)
    velocities[found.movers] = start.displacements
    return Tracked(with_displacements(past.scene, velocities), velocities, watch.seconds, len(found.movers))

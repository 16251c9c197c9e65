# SPDX-License-Identifier: Apache-2.0
"""The unit of work: fits one group of frames from header and track into a segment; can be repeated at any time.

The first frame of a group is fitted from frame 0 and the track, the others as in any stream.
"""

import hashlib
import logging
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor

from structgstream.atomic_files import remove_unused
from structgstream.cameras import CameraRig
from structgstream.data.denoising import denoised
from structgstream.data.source import FrameSource
from structgstream.errors import ConfigError
from structgstream.frames import MIN_CAMERAS, MultiViewFrame
from structgstream.groups.base import GroupBase, fingerprint, open_for
from structgstream.groups.first_frame import GroupStartConfig, fit_group_start
from structgstream.groups.segment_file import GroupSoFar, SegmentIdentity, SegmentSink, resume_segment
from structgstream.groups.track_file import TrackStart, open_track
from structgstream.groups.track_pass import dense
from structgstream.kernels.backend import Backend
from structgstream.recorder import Run, record
from structgstream.scene.scene import Scene
from structgstream.scene.state import on_device
from structgstream.session.pipeline import FrameTask, Past
from structgstream.session.presets import StreamConfig
from structgstream.session.rate_control import with_rate_control
from structgstream.session.struct_gstream import FrameZeroContext, StructGStream, stream_pipeline
from structgstream.training.online.config import OnlineConfig
from structgstream.training.online.fit import held
from structgstream.training.online.preprocess import FramePictures, preprocess
from structgstream.training.online.split import with_displacements
from structgstream.training.result import FitResult, StepListener
from structgstream.training.views import View, training_views

CATCH_UP_FRAMES = 6
"""Number of frames, from a group's first one, that also spawn what the frames before the group would have spawned."""
_log = logging.getLogger(__name__)
_OUT_OF_MEMORY = (MemoryError, torch.OutOfMemoryError)


@dataclass(frozen=True)
class GroupEntry:
    """Start of a group."""

    frame: int  # its first frame, after frame 0
    displacements: Tensor  # [M + F, 3] displacements of frame 0's primitives (Note [Primitives]) since frame 0
    velocities: Tensor  # [M + F, 3] displacements since the frame before
    first_pictures: Callable[[], MultiViewFrame]  # returns the pictures of frame 0


@dataclass
class GroupMethod:
    """The method of a group's frames. The state before its first frame is frame 0.

    If memory runs out it lowers its budget once and fits the frame again.
    """

    config: StreamConfig  # configuration of the stream
    start: GroupStartConfig  # configuration of the first frame's fit
    entry: GroupEntry | None  # start of the group; None for the group of frame 0, which is fitted as any stream
    lowered: bool = False  # whether the budget has been lowered

    @property
    def _usual(self) -> StructGStream:
        return StructGStream(self.config)

    def _config_at(self, frame: int) -> StreamConfig:
        """The configuration of a frame; that of :func:`catching_up` in the group's first :data:`CATCH_UP_FRAMES`."""
        first = None if self.entry is None else self.entry.frame
        return self.config if first is None or frame >= first + CATCH_UP_FRAMES else catching_up(self.config)

    @property
    def needs_before(self) -> bool:
        return self._usual.needs_before

    @property
    def needs_before_previous(self) -> bool:
        return self._usual.needs_before_previous

    def observe(
        self, frame: MultiViewFrame, before: Sequence[View] | None, *, rig: CameraRig, backend: Backend
    ) -> FramePictures:
        """The training pictures and their changes, which in the group's first frame are those since frame 0."""
        if self.entry is None or frame.index != self.entry.frame:
            return self._usual.observe(frame, before, rig=rig, backend=backend)
        online = self.config.online
        without_flow = replace(online.scene_flow, enabled=False)
        first = training_views(self.entry.first_pictures(), rig, backend.device)
        return preprocess(frame, rig, before=first, motion=online.motion, scene_flow=without_flow, backend=backend)

    def first(self, task: FrameTask) -> FitResult[Scene]:
        raise AssertionError("frame 0 is the header's")

    def prepare(self, state: Scene, task: Callable[[], FrameTask]) -> FrameZeroContext:
        return self._usual.prepare(state, task)

    def next(self, past: Past[Scene, FrameZeroContext], task: FrameTask) -> FitResult[Scene]:
        """Fit a frame of the group."""
        try:
            return self._fit(past, task)
        except _OUT_OF_MEMORY:
            if self.lowered:
                raise
            self.lowered, self.start = True, lowered_start(self.start)
            self.config = replace(self.config, online=lowered_budget(self.config.online))
            _log.warning(
                "Frame %d: not enough memory. From here on flow is estimated in half of the views, and a quarter of "
                "the Gaussians may be spawned; results differ slightly.",
                task.frame.index,
            )
        found = self._fit(past, task)
        return replace(found, counts={**found.counts, "lowered budgets": 1})

    def _fit(self, past: Past[Scene, FrameZeroContext], task: FrameTask) -> FitResult[Scene]:
        entry = self.entry
        if entry is not None and task.frame.index == entry.frame:
            return self._begin(entry, past, task)
        if entry is not None and task.frame.index == entry.frame + 1:
            past = replace(past, before_previous=_before_previous(past.state, entry.velocities), seconds=None)
        return StructGStream(self._config_at(task.frame.index)).next(past, task)

    def _begin(self, entry: GroupEntry, past: Past[Scene, FrameZeroContext], task: FrameTask) -> FitResult[Scene]:
        pictures, device = task.pictures, task.backend.device
        if len(pictures.views) < MIN_CAMERAS:
            return held(with_displacements(on_device(past.state, device), entry.displacements.to(device)))
        return fit_group_start(
            on_device(past.state, device),
            entry.displacements.to(device),
            pictures.views,
            pictures.changes or [None] * len(pictures.views),
            frame_index=task.frame.index,
            config=with_rate_control(self._config_at(task.frame.index).online, task.rate_scale),
            start=self.start,
            backend=task.backend,
            seed=task.seed,
            steps=task.steps,
            baseline=past.memory.baseline,
            light=past.memory.light,
            on_step=task.on_step,
        )


def catching_up(config: StreamConfig) -> StreamConfig:
    """``config`` for a group's first frames, which lack what earlier frames would have spawned.

    Thin content in small clusters is spawned although there are many of them (``ThinSpawnConfig.overflow``).
    """
    spawn = config.online.spawn
    thin = replace(spawn.thin, overflow="small-clusters")
    return replace(config, online=replace(config.online, spawn=replace(spawn, thin=thin)))


def lowered_budget(online: OnlineConfig) -> OnlineConfig:
    """``online`` with less memory: flow in half of the views, a quarter of the spawned Gaussians."""
    return replace(
        online,
        scene_flow=replace(online.scene_flow, views=max(2, online.scene_flow.views // 2)),
        spawn=replace(online.spawn, most=online.spawn.most // 4),
    )


def lowered_start(start: GroupStartConfig) -> GroupStartConfig:
    """``start`` with a quarter of the spawned Gaussians."""
    return replace(start, births=start.births // 4)


def _before_previous(state: Scene, velocities: Tensor) -> Scene:
    """The scene one frame before ``state``, the group's first: anchors moved back by their velocities."""
    anchors = state.anchors
    positions = anchors.positions - velocities[: len(anchors)].to(anchors.positions)
    return replace(state.without_free(), anchors=replace(anchors, positions=positions))


MIN_DISPLACED_PIXELS = 0.5
"""A primitive whose tracked displacement is at most this, in pixels of a median camera, counts as not displaced."""


@dataclass(frozen=True)
class SegmentTask:
    """A group of frames."""

    capture: Path  # folder of the capture
    header: Path  # stream file whose init record and frame 0 the groups share
    track: Path | None  # track of the capture, made from that header; may be None for the group of frame 0
    first: int  # the first frame, counted from the header's
    end: int  # the frame after the last one
    start: GroupStartConfig = field(default_factory=GroupStartConfig)  # configuration of the first frame's fit


def fit_segment(
    path: Path, task: SegmentTask, backend: Backend, *, overwrite: bool = False, on_step: StepListener | None = None
) -> Run | None:
    """Fits a group into the segment ``path``; resumes an interrupted fit.

    The call checks existing files. The segment is written while the run's reports are consumed; frames have the indices
    of the stream.

    Returns:
        the run; None if the segment exists, finished and undamaged.

    Raises:
        ConfigError: the existing segment is of another group, or the header has another version.
        CaptureError: the capture is not that of the header, or lacks these frames.
        StreamError: header or track is damaged, or the track has no start at the first frame.
        StorageError: the segment cannot be written, or another process writes it.
    """
    base = GroupBase.read(task.header)
    source = open_for(base.header, task.capture, frames=task.end)
    start, captured = _start(task, base), fingerprint(source)
    track = "" if start is None else hashlib.sha256(start.packed()).hexdigest()
    identity = SegmentIdentity(base.sha256, captured, track, asdict(task.start), task.first, task.end)
    if overwrite:
        remove_unused(path)
    found = resume_segment(path, base, identity)
    if found is not None and found.complete:
        return None
    records = [*found.records()] if found is not None else [] if identity.first else [base.first]
    sink, so_far = SegmentSink(path, base, identity, found), GroupSoFar(base, identity.first, records)
    method = GroupMethod(base.config, task.start, None if start is None else _entry(start, base, source))
    return record(
        path,
        source,
        # The group's first frame is denoised as frame 0 is.
        replace(stream_pipeline(base.config), method=method, denoised=(0, identity.first)),
        backend,
        storage=lambda _: (sink, so_far),
        metadata=base.header.metadata,
        on_step=on_step,
    )


def _start(task: SegmentTask, base: GroupBase) -> TrackStart | None:
    """The track's start at the first frame; None for frame 0."""
    if task.first == 0:
        return None
    if task.track is None:
        raise ConfigError(f"A group that begins at frame {task.first} needs a track; give one with --track.")
    track = open_track(task.track)
    if track.head.header != base.sha256:
        raise ConfigError(
            f"The track {task.track} was made from another header than {task.header}; track again with that one."
        )
    return track.start(task.first)


def _entry(start: TrackStart, base: GroupBase, source: FrameSource) -> GroupEntry:
    displacements, velocities = dense(base.scene(), start, step=base.position_step)
    # Smaller displacements are within the tracking error; these primitives retain frame 0's exact values.
    least = MIN_DISPLACED_PIXELS / base.config.online.rounding.at_quality("position_pixels") * base.position_step
    displacements[(displacements.abs() <= least).all(1)] = 0.0
    pictures = denoised(source, base.config.denoising)
    return GroupEntry(start.frame, displacements, velocities, lambda: next(pictures.frames(0)))

# SPDX-License-Identifier: Apache-2.0
"""Struct-GStream from the middle of a capture on: a group's first frame from frame 0 and the track, then as usual."""

import logging
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from structgstream.cameras import CameraRig
from structgstream.errors import ConfigError
from structgstream.frames import LEAST_CAMERAS, MultiViewFrame
from structgstream.groups.first_frame import GroupStartConfig, fit_group_start
from structgstream.kernels.backend import Backend
from structgstream.pipeline import FrameTask, Past
from structgstream.presets import StreamConfig
from structgstream.rate_control import with_rate_control
from structgstream.scene.scene import Scene
from structgstream.scene.state import on_device
from structgstream.struct_gstream import FrameZeroContext, StructGStream
from structgstream.training.online.config import OnlineConfig
from structgstream.training.online.fit import held
from structgstream.training.online.preprocess import FramePictures, preprocess
from structgstream.training.online.split import with_displacements
from structgstream.training.result import FitResult

CATCH_UP_FRAMES = 6
"""In so many frames from its first one on a group bears what the frames before it would have borne."""
_log = logging.getLogger(__name__)
_OUT_OF_MEMORY = (MemoryError, torch.OutOfMemoryError)


@dataclass(frozen=True)
class GroupEntry:
    """Where a group begins.

    Args:
        frame: its first frame, after frame 0.
        displacements: ``[M + F, 3]`` of frame 0's primitives (Note [Primitives]) since then.
        velocities: ``[M + F, 3]`` since the frame before.
        first_pictures: gives the pictures of frame 0.
    """

    frame: int
    displacements: Tensor
    velocities: Tensor
    first_pictures: Callable[[], MultiViewFrame]


@dataclass
class GroupMethod:
    """The method of a group's frames; the state before its first frame is frame 0.

    If memory is short it lowers its budget once, and fits the frame again.

    Args:
        config: of the stream.
        start: of the first frame's fit.
        entry: where the group begins; None for the group of frame 0, whose frames are those of any stream.
        lowered: whether the budget has been lowered.
    """

    config: StreamConfig
    start: GroupStartConfig
    entry: GroupEntry | None
    lowered: bool = False
    _first: MultiViewFrame | None = field(default=None, repr=False)

    @property
    def _usual(self) -> StructGStream:
        return StructGStream(self.config)

    def _config_at(self, frame: int) -> StreamConfig:
        """That of the stream, or where the group begins that for :data:`CATCH_UP_FRAMES`."""
        first = None if self.entry is None else self.entry.frame
        return self.config if first is None or frame >= first + CATCH_UP_FRAMES else catching_up(self.config)

    @property
    def needs_before(self) -> bool:
        """See ``StructGStream.needs_before``."""
        return self._usual.needs_before

    @property
    def needs_older(self) -> bool:
        """See ``StructGStream.needs_older``."""
        return self._usual.needs_older

    def observe(
        self, frame: MultiViewFrame, before: MultiViewFrame | None, *, rig: CameraRig, backend: Backend
    ) -> FramePictures:
        """The training pictures and their changes: in the group's first frame those since frame 0."""
        if self.entry is None or frame.index != self.entry.frame:
            return self._usual.observe(frame, before, rig=rig, backend=backend)
        online = self.config.online
        without_flow = replace(online.scene_flow, enabled=False)
        first = self.entry.first_pictures()
        return preprocess(frame, rig, before=first, motion=online.motion, start=without_flow, backend=backend)

    def first(self, task: FrameTask) -> FitResult[Scene]:
        """Frame 0 is that of the header, so that none is fitted.

        Raises:
            ConfigError: always.
        """
        raise ConfigError("A group begins from a header that has frame 0; give one with --init.")

    def prepare(self, state: Scene, task: Callable[[], FrameTask]) -> FrameZeroContext:
        """See ``StructGStream.prepare``."""
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
                "the births may come; results differ a little.",
                task.frame.index,
            )
        found = self._fit(past, task)
        return replace(found, counts={**found.counts, "lowered budgets": 1})

    def _fit(self, past: Past[Scene, FrameZeroContext], task: FrameTask) -> FitResult[Scene]:
        entry = self.entry
        if entry is not None and task.frame.index == entry.frame:
            return self._begin(entry, past, task)
        if entry is not None and task.frame.index == entry.frame + 1:
            past = replace(past, older=_older(past.state, entry.velocities), seconds=None)
        return StructGStream(self._config_at(task.frame.index)).next(past, task)

    def _begin(self, entry: GroupEntry, past: Past[Scene, FrameZeroContext], task: FrameTask) -> FitResult[Scene]:
        pictures, device = task.pictures, task.backend.device
        if len(pictures.views) < LEAST_CAMERAS:
            return held(with_displacements(on_device(past.state, device), entry.displacements.to(device)))
        return fit_group_start(
            on_device(past.state, device),
            entry.displacements.to(device),
            pictures.views,
            pictures.changes or [None] * len(pictures.views),
            frame_index=task.frame.index,
            config=with_rate_control(self._config_at(task.frame.index).online, task.pressure),
            start=self.start,
            backend=task.backend,
            seed=task.seed,
            steps=task.steps,
            floor=past.memory.floor,
            light=past.memory.light,
            on_step=task.on_step,
        )


def catching_up(config: StreamConfig) -> StreamConfig:
    """``config`` for a group's first frames, which lack what the frames before them would have borne: thin births in
    small clusters come also where there are many (``ThinSpawnConfig.overflow``)."""
    births = config.online.spawn
    thin = replace(births.thin, overflow="small-clusters")
    return replace(config, online=replace(config.online, spawn=replace(births, thin=thin)))


def lowered_budget(online: OnlineConfig) -> OnlineConfig:
    """``online`` with less memory: flow in half of the views, a quarter of the births."""
    return replace(
        online,
        scene_flow=replace(online.scene_flow, views=max(2, online.scene_flow.views // 2)),
        spawn=replace(online.spawn, most=online.spawn.most // 4),
    )


def lowered_start(start: GroupStartConfig) -> GroupStartConfig:
    """``start`` with a quarter of the births."""
    return replace(start, births=start.births // 4)


def _older(state: Scene, velocities: Tensor) -> Scene:
    """The scene one frame before ``state``, the group's first: anchors where velocities say, without births."""
    anchors = state.anchors
    positions = anchors.positions - velocities[: len(anchors)].to(anchors.positions)
    return replace(state.without_free(), anchors=replace(anchors, positions=positions))

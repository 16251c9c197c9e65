# SPDX-License-Identifier: Apache-2.0
"""The serial pass: movers of frame 0 followed through every frame of a capture, into a track.

At a start what is stored is rounded, and the pass goes on from the rounded values, so that an interrupted pass that
goes on from its last start writes the same bytes.
"""

import time
from collections.abc import Generator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import torch

from structgstream.data.prefetch import read_ahead
from structgstream.data.source import FrameSource
from structgstream.data.wrappers import select_cameras
from structgstream.errors import ConfigError
from structgstream.groups.base import GroupBase
from structgstream.groups.boundaries import equal_groups, quiet_groups
from structgstream.groups.growing_file import partial_path, write_whole
from structgstream.groups.pictures import fingerprint
from structgstream.groups.track_file import TrackFile, TrackHead, TrackStart, TrackWriter, open_track
from structgstream.kernels.backend import Backend
from structgstream.lookahead import Lookahead
from structgstream.scene.scene import Scene
from structgstream.scene.state import on_device
from structgstream.training.motion_start import with_displacements
from structgstream.training.residuals import ResidualFloor, residual_floor
from structgstream.training.tracking import (
    TrackConfig,
    Tracked,
    Tracker,
    TrackPictures,
    spread_cameras,
    track_frame,
)
from structgstream.training.views import View


@dataclass(frozen=True)
class TrackOptions:
    """Options of a pass.

    Args:
        length: frames of a group.
        quiet: whether groups begin where little moves, rather than at equal distances.
        tracking: how movers are followed.
    """

    length: int
    quiet: bool = False
    tracking: TrackConfig = field(default_factory=TrackConfig)


@dataclass(frozen=True)
class TrackProgress:
    """One tracked frame.

    Args:
        frame: its index.
        moved: number of movers that were followed.
        changed: share of pixels that changed.
        cpu_seconds: processor time of all threads.
        seconds: wall-clock seconds by stage.
        stored_bytes: of its start record; 0 if it has none.
    """

    frame: int
    moved: int
    changed: float
    cpu_seconds: float
    seconds: Mapping[str, float]
    stored_bytes: int = 0


def groups_path(track: Path) -> Path:
    """The path of a track's list of groups, one ``a:b`` a line."""
    return track.with_name(f"{track.name}.groups")


def track_capture(
    path: Path, source: FrameSource, base: GroupBase, options: TrackOptions, backend: Backend
) -> Generator[TrackProgress, None, None]:
    """Tracks through ``source`` into the file ``path``; goes on where an interrupted pass has stopped.

    The generator yields after each frame; a track that is finished yields nothing.

    Raises:
        ConfigError: ``path`` is another track.
        StorageError: it cannot be written.
    """
    # Every second of key packets may be a quiet place; other passes need their own starts only.
    every = min(base.key_interval, options.length) if options.quiet else options.length
    head = TrackHead(
        header=base.sha256,
        capture=fingerprint(source),
        step=base.position_step,
        movers=len(base.scene().anchors) + len(base.scene().free),
        every=every,
        config=asdict(options.tracking) | {"length": options.length, "quiet": options.quiet, "frames": len(source)},
    )
    found = _existing(path, head)
    if found is not None and found.groups is not None:
        return
    if not options.quiet:
        _write_groups(path, equal_groups(len(source), options.length))
    done = [] if found is None else [*found.whole_starts()]
    last = done[-1][0] if done else None
    writer = TrackWriter(path, head, keep=done[-1][1] if done else 0)
    try:
        past = Pass.at(base, source, options.tracking, backend, last)
        changed = {start.frame: float(start.changed[-1]) for start, _ in done}
        yield from _frames(past, source, writer, every=every, changed=changed)
        frames = len(source)
        quiet = options.quiet
        groups = quiet_groups(frames, options.length, changed) if quiet else equal_groups(frames, options.length)
        _write_groups(path, groups)
        writer.finish(frames, groups)
    finally:
        writer.close()


def _existing(path: Path, head: TrackHead) -> TrackFile | None:
    """What is there of the track; None without anything.

    Raises:
        ConfigError: it is another track.
    """
    if not path.exists() and (not partial_path(path).exists() or partial_path(path).stat().st_size < 64):
        return None
    found = open_track(path)
    if vars(found.head) != vars(head):
        differing = [name for name, value in vars(head).items() if getattr(found.head, name) != value]
        raise ConfigError(
            f"{path} is a track of another {' and '.join(differing)}; give the same header, capture and options, "
            "another name, or --overwrite."
        )
    return found


def _write_groups(path: Path, groups: list[tuple[int, int]]) -> None:
    write_whole(groups_path(path), "".join(f"{first}:{end}\n" for first, end in groups).encode())


@dataclass
class Pass:
    """The state of a pass.

    Args:
        first: frame 0.
        tracker: how movers are followed.
        floor: residuals of frame 0.
        step: of positions.
        tracked: where movers are in the last frame.
        index: the last frame.
    """

    first: Scene
    tracker: Tracker
    floor: ResidualFloor
    step: float
    tracked: Tracked
    index: int

    @classmethod
    def at(
        cls, base: GroupBase, source: FrameSource, config: TrackConfig, backend: Backend, start: TrackStart | None
    ) -> "Pass":
        """The state at ``start``, or at frame 0."""
        online, scene = base.config.online, on_device(base.scene(), backend.device)
        rig = base.header.similarity.rig(base.header.rig)
        tracker = Tracker.of(config, online.motion, online.start, rig=rig, backend=backend)
        views = tracker.views(next(_cameras(source, config).frames(0)))
        floor = residual_floor(scene, views, scale=tracker.motion.picture_scale, backend=backend)
        tracked, index = Tracked.at_rest(scene), 0
        if start is not None:
            tracked, index = tracked_at(scene, start, step=base.position_step), start.frame
        return cls(scene, tracker, floor, base.position_step, tracked, index)

    def start(self, changed: list[float]) -> TrackStart:
        """The start record of the last frame; the state is rounded to it."""
        z = torch.cat([self.first.anchors.positions, self.first.free.means])
        now = torch.cat([self.tracked.scene.anchors.positions, self.tracked.scene.free.means])
        displacements = ((now - z) / self.step).round().to(torch.int32).cpu()
        velocities = (self.tracked.velocities / self.step).round().to(torch.int32).cpu()
        rows = ((displacements != 0) | (velocities != 0)).any(1).nonzero()[:, 0]
        stored = TrackStart(
            self.index,
            rows.to(torch.int32).numpy(),
            displacements[rows].numpy(),
            velocities[rows].numpy(),
            np.asarray(changed, np.float32),
        )
        self.tracked = tracked_at(self.first, stored, step=self.step)
        return stored


def tracked_at(first: Scene, start: TrackStart, *, step: float) -> Tracked:
    """Where the movers of frame 0 are at ``start``."""
    displacements, velocities = dense(first, start, step=step)
    return Tracked(with_displacements(first, displacements), velocities)


def dense(first: Scene, start: TrackStart, *, step: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Displacements since frame 0 and velocities at ``start``, ``[M + F, 3]`` each, in units of the scene."""
    like, rows = first.anchors.positions, torch.from_numpy(start.movers).to(first.anchors.positions.device).long()
    found = []
    for values in (start.displacements, start.velocities):
        full = torch.zeros(len(first.anchors) + len(first.free), 3).to(like)
        full[rows] = torch.from_numpy(values).to(like) * step
        found.append(full)
    return found[0], found[1]


def _cameras(source: FrameSource, config: TrackConfig) -> FrameSource:
    """The capture of the cameras that are tracked with, so that no other pictures are decoded."""
    return select_cameras(source, spread_cameras(source.rig, config.cameras))


def _frames(
    past: Pass, source: FrameSource, writer: TrackWriter, *, every: int, changed: dict[int, float]
) -> Generator[TrackProgress, None, None]:
    """Tracks from the frame after ``past`` to the end; ``changed`` gets the change at each start."""
    shares: list[float] = []
    began = time.process_time()
    with Lookahead(_observed(past, source)) as observed:
        for index, pictures in observed:
            past.tracked = track_frame(past.tracker, past.tracked, pictures, past.floor)
            past.index, seconds = index, past.tracked.seconds
            moved, stored = past.tracked.moved, 0
            shares.append(pictures.changed_share)
            if index % every == 0:
                start = past.start(shares)
                stored, changed[index], shares = writer.write(start), float(start.changed[-1]), []
            share, now = pictures.changed_share, time.process_time()
            yield TrackProgress(index, moved, share, now - began, seconds, stored)
            began = now


def _observed(past: Pass, source: FrameSource) -> Generator[tuple[int, TrackPictures], None, None]:
    """Every frame after that of ``past`` with its reduced pictures and what changed, made while another is tracked."""
    chosen = _cameras(source, TrackConfig(cameras=past.tracker.start.views))
    frames = read_ahead(chosen).frames(past.index)
    before: list[View] = past.tracker.views(next(frames))
    for frame in frames:
        pictures = past.tracker.pictures(frame, before)
        before = pictures.views
        yield frame.index, pictures

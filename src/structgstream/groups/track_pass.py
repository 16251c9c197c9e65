# SPDX-License-Identifier: Apache-2.0
"""The serial tracking pass: follows the primitives of frame 0 through every frame of a capture into a track.

At each start the pass continues from the rounded values that it stores. A pass that is resumed from its last start
therefore writes the same bytes.
"""

import time
from collections.abc import Generator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from structgstream.atomic_files import name_finished, name_unfinished, partial_path
from structgstream.data.source import FrameSource, read_ahead
from structgstream.errors import ConfigError, StreamError
from structgstream.groups.base import GroupBase, fingerprint
from structgstream.groups.segment_file import GroupSoFar, Segment
from structgstream.groups.track_file import (
    TrackFile,
    TrackHead,
    TrackStart,
    TrackWriter,
    equal_groups,
    groups_path,
    open_track,
    quiet_groups,
    write_groups,
)
from structgstream.groups.tracking import TrackConfig, Tracked, Tracker, TrackPictures, track_frame
from structgstream.kernels.backend import Backend
from structgstream.lookahead import Lookahead
from structgstream.scene.scene import Scene
from structgstream.scene.state import on_device
from structgstream.training.online.split import with_displacements


@dataclass(frozen=True)
class TrackOptions:
    """Options of a pass."""

    length: int  # frames of a group
    quiet: bool = False  # whether groups begin at frames with little motion rather than at equal distances
    # a finished group from whose last frame the pass starts, which corrects earlier tracking errors
    after: Segment | None = None
    tracking: TrackConfig = field(default_factory=TrackConfig)  # configuration of the tracking

    @property
    def first(self) -> int:
        """The first frame of the first group."""
        return 0 if self.after is None else self.after.identity.end


@dataclass(frozen=True)
class TrackProgress:
    """Report of one tracked frame."""

    frame: int  # its index
    cpu_seconds: float  # processor time of all threads


def track_capture(
    path: Path, source: FrameSource, base: GroupBase, options: TrackOptions, backend: Backend
) -> Generator[TrackProgress, None, None]:
    """Tracks through ``source`` into the file ``path``; resumes an interrupted pass.

    The generator yields after each frame, and nothing for a complete track, whose file is renamed if an earlier pass
    was killed just before it renamed it.

    Raises:
        StreamError: ``path`` is an existing file, but no track.
        ConfigError: ``path`` is a track of another header, capture or configuration, or no frame is after the group
            ``options.after``.
        StorageError: it cannot be written.
    """
    if options.after is not None and options.first >= len(source):
        raise ConfigError(
            f"{options.after.name} has the frames to before {options.first}, and {len(source)} frames are to be "
            "tracked, so none is after it; track on from an earlier group, or give more --frames."
        )
    # With ``quiet``, a group may begin at any key packet; otherwise only at multiples of its length.
    every = min(base.key_interval, options.length) if options.quiet else options.length
    head = TrackHead(
        header=base.sha256,
        capture=fingerprint(source),
        step=base.position_step,
        primitives=len(base.scene().anchors) + len(base.scene().free),
        every=every,
        config=asdict(options.tracking)
        | {"length": options.length, "quiet": options.quiet, "frames": len(source)}
        | ({} if options.after is None else {"after": options.after.identity.sha256}),
    )
    found = _existing(path, head)
    if found is not None and found.groups is not None:
        # The pass may have been killed after its last record.
        if not groups_path(path).exists():
            write_groups(path, found.groups)
        if not path.exists():
            name_finished(path)
        return
    if not options.quiet:
        write_groups(path, _groups(options, len(source), {}))
    done = [] if found is None else [*found.whole_starts()]
    writer = TrackWriter(path, head, keep=done[-1][1] if done else 0)
    try:
        last = done[-1][0] if done else None
        if last is None and options.after is not None:
            last = start_after(options.after, base)
            writer.write(last)
        changed = {start.frame: float(start.changed[-1]) for start, _ in done if len(start.changed)}
        past = Pass.at(base, options.tracking, backend, last)
        yield from _frames(past, source, writer, first=options.first, every=every, changed=changed)
        groups = _groups(options, len(source), changed)
        write_groups(path, groups)
        writer.finish(len(source), groups)
    finally:
        writer.close()


def _groups(options: TrackOptions, frames: int, changed: Mapping[int, float]) -> list[tuple[int, int]]:
    """The groups of a capture of ``frames`` frames; with ``options.after`` only those after that group."""
    first = options.first
    if options.quiet:
        later = {frame - first: share for frame, share in changed.items() if frame > first}
        found = quiet_groups(frames - first, options.length, later)
    else:
        found = equal_groups(frames - first, options.length)
    return [(first + begin, first + end) for begin, end in found]


def start_after(group: Segment, base: GroupBase) -> TrackStart:
    """Start at the last frame of a finished group: displacements of frame 0's primitives, without spawned ones. Raises
    ConfigError if the group is not finished, or has another header."""
    if not group.complete or group.init != base.init:
        what = "is not finished" if not group.complete else "has another header"
        raise ConfigError(f"{group.name} {what}; track on from a finished group of the same header.")
    identity, first = group.identity, base.scene()
    so_far = GroupSoFar(base, identity.first, [*group.records()])
    last, before = so_far.scene(identity.end - 1), so_far.scene(max(identity.end - 2, identity.first))
    at, then, z = (scene.anchors.positions for scene in (last, before, first))
    return _rounded(identity.end - 1, at - z, at - then, [], step=base.position_step)


def _rounded(frame: int, moved: Tensor, velocities: Tensor, changed: list[float], *, step: float) -> TrackStart:
    """A start record from displacements ``[M + F, 3]`` since frame 0 and the frame before, in units of the scene."""
    moved, velocities = ((values / step).round().to(torch.int32).cpu() for values in (moved, velocities))
    rows = ((moved != 0) | (velocities != 0)).any(1).nonzero()[:, 0]
    shares = np.asarray(changed, np.float32)
    return TrackStart(frame, rows.to(torch.int32).numpy(), moved[rows].numpy(), velocities[rows].numpy(), shares)


def _existing(path: Path, head: TrackHead) -> TrackFile | None:
    """The existing part of the track; None if there is none."""
    if not path.exists() and not partial_path(path).exists():
        return None
    try:
        found = open_track(path)
    except StreamError:
        if path.exists():
            raise
        return None  # A pass that was interrupted before its first start.
    if vars(found.head) != vars(head):
        differing = [name for name, value in vars(head).items() if getattr(found.head, name) != value]
        raise ConfigError(
            f"{path} is a track of another {' and '.join(differing)}; give the same header, capture and options, "
            "another name, or --overwrite."
        )
    if found.groups is None and path.exists():
        name_unfinished(path)  # It is damaged at its end.
    return found


@dataclass
class Pass:
    """State of a pass."""

    first: Scene  # scene of frame 0
    tracker: Tracker  # follows primitives from frame to frame
    step: float  # quantization step of positions, in units of the scene
    tracked: Tracked  # primitives in the last frame
    index: int  # index of the last frame

    @classmethod
    def at(cls, base: GroupBase, config: TrackConfig, backend: Backend, start: TrackStart | None) -> "Pass":
        """The state at ``start``, or at frame 0."""
        scene, step = on_device(base.scene(), backend.device), base.position_step
        rig = base.header.similarity.rig(base.header.rig)
        tracker = Tracker(config, base.config.online.motion, rig, backend)
        if start is None:
            return cls(scene, tracker, step, Tracked.at_rest(scene), 0)
        return cls(scene, tracker, step, tracked_at(scene, start, step=step), start.frame)

    def start(self, changed: list[float]) -> TrackStart:
        """The start record of the last frame; rounds the state to it."""
        z = torch.cat([self.first.anchors.positions, self.first.free.means])
        now = torch.cat([self.tracked.scene.anchors.positions, self.tracked.scene.free.means])
        found = _rounded(self.index, now - z, self.tracked.velocities, changed, step=self.step)
        stored = TrackStart.unpacked(found.packed())  # A resumed pass reads these values.
        self.tracked = tracked_at(self.first, stored, step=self.step)
        return stored


def tracked_at(first: Scene, start: TrackStart, *, step: float) -> Tracked:
    """The primitives of frame 0, displaced as in ``start``."""
    displacements, velocities = dense(first, start, step=step)
    return Tracked(with_displacements(first, displacements), velocities)


def dense(first: Scene, start: TrackStart, *, step: float) -> tuple[Tensor, Tensor]:
    """Displacements since frame 0 and since the frame before ``start``, ``[M + F, 3]`` each, in units of the scene."""
    like, rows = first.anchors.positions, torch.from_numpy(start.primitives).to(first.anchors.positions.device).long()
    found = []
    for values in (start.displacements, start.velocities):
        full = torch.zeros(len(first.anchors) + len(first.free), 3).to(like)
        full[rows] = torch.from_numpy(values).to(like) * step
        found.append(full)
    return found[0], found[1]


def _frames(
    past: Pass, source: FrameSource, writer: TrackWriter, *, first: int, every: int, changed: dict[int, float]
) -> Generator[TrackProgress, None, None]:
    """Tracks from the frame after ``past`` to the end, with starts at equal distances from ``first`` on.

    Adds the change at each start to ``changed``.
    """
    shares: list[float] = []
    began = time.process_time()
    with Lookahead(_prepared_pictures(past, source)) as prepared:
        for pictures in prepared:
            past.tracked = track_frame(past.tracker, past.tracked, pictures)
            past.index = index = pictures.index
            shares.append(pictures.changed_share)
            if index >= first and (index - first) % every == 0:
                start = past.start(shares)
                writer.write(start)
                changed[index], shares = float(start.changed[-1]), []
            now = time.process_time()
            yield TrackProgress(index, now - began)
            began = now


def _prepared_pictures(past: Pass, source: FrameSource) -> Generator[TrackPictures, None, None]:
    """Reduced pictures and changes of every frame after that of ``past``; a thread prepares the next frame's."""
    frames = read_ahead(source).frames(past.index)
    before = past.tracker.pictures(next(frames), None).views
    for frame in frames:
        found = past.tracker.pictures(frame, before)
        before = found.views or before  # A frame without pictures is treated as static.
        yield found

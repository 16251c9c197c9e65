# SPDX-License-Identifier: Apache-2.0
"""The unit of work: fits one group of frames from header and track into a segment; can be repeated at any time."""

import hashlib
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from pathlib import Path

from structgstream.atomic_files import partial_path
from structgstream.data.denoising import denoised
from structgstream.data.source import FrameSource
from structgstream.errors import ConfigError, StorageError
from structgstream.frames import MultiViewFrame
from structgstream.groups.base import GroupBase
from structgstream.groups.first_frame import GroupStartConfig
from structgstream.groups.method import GroupEntry, GroupMethod
from structgstream.groups.pictures import fingerprint, open_for
from structgstream.groups.segment_file import Segment, SegmentIdentity
from structgstream.groups.segment_sink import GroupSoFar, SegmentSink, resume_segment
from structgstream.groups.track_file import TrackStart, open_track
from structgstream.groups.track_pass import dense
from structgstream.kernels.backend import Backend
from structgstream.recorder import LogExtras, Run, record
from structgstream.scene.scene import Scene
from structgstream.session.pipeline import Pipeline
from structgstream.session.struct_gstream import FrameZeroContext, stream_pipeline
from structgstream.training.result import StepListener

MIN_PIXELS = 0.5
"""A primitive whose tracked displacement is at most this, in pixels of a median camera, counts as not displaced."""


@dataclass(frozen=True)
class SegmentTask:
    """A group of frames.

    Args:
        capture: folder of the capture.
        header: stream file whose init record and frame 0 the groups share.
        track: track of the capture, made from that header; may be None for the group of frame 0.
        first: the first frame, counted from the header's.
        end: the frame after the last one.
        start: configuration of the first frame's fit.
    """

    capture: Path
    header: Path
    track: Path | None
    first: int
    end: int
    start: GroupStartConfig = field(default_factory=GroupStartConfig)


def fit_segment(
    path: Path,
    task: SegmentTask,
    backend: Backend,
    *,
    overwrite: bool = False,
    on_step: StepListener | None = None,
    remarks: LogExtras | None = None,
) -> Run | None:
    """Fits a group into the segment ``path``; resumes an interrupted fit.

    The call checks existing files. The segment is written while the run's reports are consumed; frames have the indices
    of the stream.

    Args:
        path: path of the segment.
        task: the group.
        backend: the compute back-end.
        overwrite: remove an existing segment.
        on_step: called after every optimisation step.
        remarks: see ``recorder.LogExtras``.

    Returns:
        the run; None if the segment exists, finished and undamaged.

    Raises:
        ConfigError: the range is empty, the existing segment is of another group, or the header has another version.
        CaptureError: the capture is not that of the header, or lacks these frames.
        StreamError: header or track is damaged, or the track has no start at the first frame.
        StorageError: the segment cannot be written, or another process writes it.
    """
    if not 0 <= task.first < task.end:
        raise ConfigError(f"Frames {task.first}:{task.end} are no group; the first must be from 0 to before the end.")
    base = GroupBase.read(task.header)
    source = open_for(base.header, task.capture, frames=task.end)
    start, captured = _start(task, base), fingerprint(source)
    track = "" if start is None else hashlib.sha256(start.packed()).hexdigest()
    identity = SegmentIdentity(base.sha256, captured, track, asdict(task.start), task.first, task.end)
    if overwrite:
        _remove(path)
    found = resume_segment(path, base, identity)
    if found is not None and found.complete:
        found.close()
        return None
    return _run(path, source, base, identity, found, task.start, start, backend, on_step=on_step, remarks=remarks)


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


def _run(
    path: Path,
    source: FrameSource,
    base: GroupBase,
    identity: SegmentIdentity,
    found: Segment | None,
    config: GroupStartConfig,
    start: TrackStart | None,
    backend: Backend,
    *,
    on_step: StepListener | None,
    remarks: LogExtras | None,
) -> Run:
    path.parent.mkdir(parents=True, exist_ok=True)
    records = [base.first] if found is None and not identity.first else []
    if found is not None:
        records = [found.record(number) for number in range(len(found.entries))]
        found.close()
    sink = SegmentSink(path, base, identity, found)
    so_far = GroupSoFar(base, identity.first, records)
    method = GroupMethod(base.config, config, None if start is None else _entry(start, base, source))
    return record(
        path,
        source,
        _pipeline(base, method, identity.first),
        backend,
        storage=lambda _: (sink, so_far),
        metadata=base.header.metadata,
        on_step=on_step,
        remarks=remarks,
    )


def _entry(start: TrackStart, base: GroupBase, source: FrameSource) -> GroupEntry:
    displacements, velocities = dense(base.scene(), start, step=base.position_step)
    # Smaller displacements are within the tracking error; these primitives retain frame 0's exact values.
    least = MIN_PIXELS / base.config.online.rounding.at_quality("position_pixels") * base.position_step
    displacements[(displacements.abs() <= least).all(1)] = 0.0

    @cache
    def first_pictures() -> MultiViewFrame:
        return next(denoised(source, base.config.denoising).frames(0))

    return GroupEntry(start.frame, displacements, velocities, first_pictures)


def _pipeline(base: GroupBase, method: GroupMethod, first: int) -> Pipeline[Scene, FrameZeroContext]:
    """The pipeline of the stream with the group's method; the group's first frame is denoised as frame 0 is."""
    return replace(stream_pipeline(base.config), method=method, denoised=(0, first))


def _remove(path: Path) -> None:
    try:
        for name in (path, partial_path(path)):
            name.unlink(missing_ok=True)
    except OSError as error:
        raise StorageError(f"{path} cannot be replaced ({error.strerror}).") from error

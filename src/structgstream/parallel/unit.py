# SPDX-License-Identifier: Apache-2.0
"""The commands of a parallel run as tasks: header, tracking pass, a group each, join."""

import tempfile
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from structgstream.atomic_files import partial_path
from structgstream.errors import StreamError
from structgstream.executors.task import PYTHON, Task, thread_environment
from structgstream.groups.boundaries import Groups
from structgstream.parallel.parts import Parts, group_name

HEADER, TRACK, JOIN = "header", "track", "join"
PROGRAM = (PYTHON, "-m", "structgstream")


class ReadsTrack(Protocol):
    """Gives the frames at which a group may start, of a track that is finished or growing."""

    def __call__(self, track: Path, /) -> Collection[int]: ...


class CutsTrack(Protocol):
    """Extracts from a track the start of a single group."""

    def __call__(self, track: Path, first: int, /) -> bytes: ...


def starts_in(track: Path) -> Collection[int]:
    """The starts in a file of ``structgstream track``; none before its head is written."""
    from structgstream.groups.track_file import open_track

    try:
        return open_track(track).starts
    except StreamError:
        return ()


def cut_track(track: Path, first: int) -> bytes:
    """An unfinished track with the one start that a group needs.

    Raises:
        StreamError: there is none, or it is damaged.
    """
    from structgstream.groups.track_file import TrackWriter, open_track

    found = open_track(track)
    start = found.start(first)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "start"
        writer = TrackWriter(path, found.head)
        writer.write(start)
        writer.close()
        return partial_path(path).read_bytes()


@dataclass(frozen=True)
class Unit:
    """Options of the commands.

    Args:
        capture: folder of the capture.
        frames: number of frames; None for all.
        header: further arguments of ``reconstruct`` for frame 0: preset, scale, held-out cameras.
        track: further arguments of ``track``: length of groups.
        track_threads: threads of the tracking pass, which all groups wait for; None for those of its worker slot.
        device: further arguments of all commands: the back-end.
        join: further arguments of ``join``: number of processes.
        program: runs the commands.
        starts: reads a track.
        cut: extracts from a track what one group needs.
    """

    capture: str
    frames: int | None = None
    header: tuple[str, ...] = ()
    track: tuple[str, ...] = ()
    track_threads: int | None = None
    device: tuple[str, ...] = ()
    join: tuple[str, ...] = ()
    program: tuple[str, ...] = PROGRAM
    starts: ReadsTrack = field(default=starts_in, compare=False)
    cut: CutsTrack = field(default=cut_track, compare=False)

    def header_task(self, parts: Parts) -> Task:
        """Fits frame 0, which all groups share."""
        argv = (*self.program, "reconstruct", self.capture, "-o", str(parts.header), "--frames", "1", "--resume")
        return Task(HEADER, (*argv, *self.header, *self.device), str(parts.header), parts.log(HEADER))

    def track_task(self, parts: Parts) -> Task:
        """The tracking pass."""
        argv = (*self.program, "track", self.capture, "--init", str(parts.header), "-o", str(parts.track))
        count = () if self.frames is None else ("--frames", str(self.frames))
        command = (*argv, *count, *self.track, *self.device)
        variables = {} if self.track_threads is None else thread_environment(self.track_threads)
        return Task(TRACK, command, str(parts.track), parts.log(TRACK), variables)

    def group_task(self, parts: Parts, first: int, end: int) -> Task:
        """Fits a group to a segment."""
        name, segment = group_name(first, end), str(parts.segment(first, end))
        argv = (*self.program, "fit-group", self.capture, "--init", str(parts.header), "--track", str(parts.track))
        command = (*argv, "--frames", f"{first}:{end}", "-o", segment, *self.device)
        return Task(name, command, segment, parts.log(name))

    def join_task(self, parts: Parts, groups: Groups, output: Path) -> Task:
        """Joins all segments to the stream."""
        segments = [str(parts.segment(first, end)) for first, end in groups]
        command = (*self.program, "join", *segments, "-o", str(output), "--overwrite", *self.device, *self.join)
        return Task(JOIN, command, str(output), parts.log(JOIN))

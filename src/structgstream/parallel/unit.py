# SPDX-License-Identifier: Apache-2.0
"""The commands that a parallel run consists of, as tasks: header, tracking pass, a group each, joining."""

import tempfile
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from structgstream.atomic_files import partial_path
from structgstream.errors import StreamError
from structgstream.executors.task import PYTHON, Task
from structgstream.executors.worker_slots import thread_environment
from structgstream.groups.group_list import Groups
from structgstream.parallel.parts import Parts, group_name

HEADER, TRACK, JOIN = "header", "track", "join"
PROGRAM = (PYTHON, "-m", "structgstream")


class ReadsTrack(Protocol):
    """Tells the frames at which a group may begin by now, of a track that is finished or grows."""

    def __call__(self, track: Path, /) -> Collection[int]: ...


class CutsTrack(Protocol):
    """Makes of a track one with the start of a single group, which is all that it reads."""

    def __call__(self, track: Path, first: int, /) -> bytes: ...


def starts_in(track: Path) -> Collection[int]:
    """The starts of a file of ``structgstream track``; none while it has no head yet."""
    from structgstream.groups.track_file import open_track

    try:
        return open_track(track).starts
    except StreamError:
        return ()


def cut_track(track: Path, first: int) -> bytes:
    """A track with the one start that a group needs, as it is while its pass runs.

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
    """What is asked of the commands.

    Args:
        capture: its folder.
        frames: of the stream; None for all.
        header: further words for ``reconstruct`` when it fits frame 0: preset, scale, held-out cameras.
        track: further words for ``track``: length of groups.
        track_threads: of the tracking pass, which all groups wait for; None for those of its place.
        device: further words for all of them: which back-end computes.
        join: further words for ``join``: how many processes hand over.
        program: what the commands are given to.
        starts: reads a track.
        cut: takes from a track what one group needs.
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
        """Frame 0, which all groups share."""
        words = (*self.program, "reconstruct", self.capture, "-o", str(parts.header), "--frames", "1", "--resume")
        return Task(HEADER, (*words, *self.header, *self.device), str(parts.header), parts.log(HEADER))

    def track_task(self, parts: Parts) -> Task:
        """The serial pass."""
        words = (*self.program, "track", self.capture, "--init", str(parts.header), "-o", str(parts.track))
        count = () if self.frames is None else ("--frames", str(self.frames))
        command = (*words, *count, *self.track, *self.device)
        variables = {} if self.track_threads is None else thread_environment(self.track_threads)
        return Task(TRACK, command, str(parts.track), parts.log(TRACK), variables)

    def group_task(self, parts: Parts, first: int, end: int) -> Task:
        """A segment."""
        name, segment = group_name(first, end), str(parts.segment(first, end))
        words = (*self.program, "fit-group", self.capture, "--init", str(parts.header), "--track", str(parts.track))
        command = (*words, "--frames", f"{first}:{end}", "-o", segment, *self.device)
        return Task(name, command, segment, parts.log(name))

    def join_task(self, parts: Parts, groups: Groups, output: Path) -> Task:
        """The stream, of all segments."""
        segments = [str(parts.segment(first, end)) for first, end in groups]
        command = (*self.program, "join", *segments, "-o", str(output), "--overwrite", *self.device, *self.join)
        return Task(JOIN, command, str(output), parts.log(JOIN))

# SPDX-License-Identifier: Apache-2.0
"""Costs from the notes and logs of a parallel run, long or as short as a probe of two groups."""

from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

from structgstream.errors import ConfigError
from structgstream.evaluation.run_log import read_log
from structgstream.groups.group_list import read_groups
from structgstream.parallel.cost import Costs
from structgstream.parallel.parts import Note, Parts, group_name
from structgstream.parallel.unit import HEADER, JOIN, TRACK


@dataclass(frozen=True)
class Measured:
    """What a run has shown.

    Args:
        costs: of one of its workers.
        frames: of the run.
        groups: that were measured; those that were begun more than once are not.
        seconds: of all its tasks together.
    """

    costs: Costs
    frames: int
    groups: int
    seconds: float


def measured_in(folder: Path) -> Measured:
    """The costs of the run whose parts are in ``folder``.

    A group's process takes longer than its frames: that time is counted as the start of every process, of the tracking
    pass and of joining, too.

    Raises:
        ConfigError: there is no finished run, or none with a group that begins after frame 0.
    """
    parts = Parts(folder)
    groups = [(parts.notes.get(group_name(a, b)), a, b) for a, b in read_groups(parts.track) or ()]
    if not {HEADER, TRACK, JOIN} <= parts.notes.keys() or any(note is None for note, _, _ in groups):
        raise ConfigError(
            f"{folder} has no finished parallel run; give the OUT.parts of one, or none, so that two groups are fitted."
        )
    whole = [(note, _frames(parts, a, b)) for note, a, b in groups if note is not None and note.attempts == 1 and a]
    whole = [(note, log) for note, log in whole if len(log) == note.frames]
    later = [entry for _, log in whole for entry in log[1:]]
    if not later:
        raise ConfigError(f"{folder} has no group of two frames that was fitted without a break; fit more groups.")
    process = fmean(max(note.seconds - sum(entry["total_seconds"] for entry in log), 0.0) for note, log in whole)
    first_seconds = fmean(log[0]["total_seconds"] for _, log in whole)
    frame_seconds = fmean(entry["total_seconds"] for entry in later)
    track, join, header = (parts.notes[name] for name in (TRACK, JOIN, HEADER))
    keys = [entry["bytes"] for entry in later if entry["kind"] == "key"]
    first_bytes = fmean(log[0]["bytes"] for _, log in whole)
    costs = Costs(
        header_seconds=header.seconds,
        track_start_seconds=_start(track, process),
        track_seconds=(track.seconds - _start(track, process)) / max(track.frames - 1, 1),
        process_seconds=process,
        first_seconds=max(first_seconds - frame_seconds, 0.0),
        frame_seconds=frame_seconds,
        join_start_seconds=_start(join, process),
        join_seconds=(join.seconds - _start(join, process)) / join.frames,
        header_bytes=header.bytes,
        first_bytes=first_bytes,
        key_bytes=fmean(keys) if keys else first_bytes,
        frame_bytes=fmean([entry["bytes"] for entry in later if entry["kind"] != "key"] or [first_bytes]),
        worker_bytes=max(note.peak_bytes for note in parts.notes.values()),
    )
    return Measured(costs, track.frames, len(whole), sum(note.seconds for note in parts.notes.values()))


def _start(note: Note, process: float) -> float:
    """How much of a task is the start of its process."""
    return min(process, note.seconds)


def _frames(parts: Parts, first: int, end: int) -> list[dict[str, Any]]:
    """The log of a group, in the order of its frames."""
    log = read_log(parts.segment(first, end))
    return [log[i] for i in range(first, end) if i in log]

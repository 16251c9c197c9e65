# SPDX-License-Identifier: Apache-2.0
"""What a parallel run costs: seconds on so many workers, bytes, and how many workers a wanted finish takes.

All follows from what the notes and logs of a run have measured, which may be as short as a probe of two groups.

Note [Serial part]: frame 0 is fitted before anything else, the tracking pass goes through all frames on one worker, and
joining comes last. The first does not grow with the capture; the second and third grow with its frames, whatever the
number of workers. A group waits for the pass to come to it, so that no number of workers ends before the pass has, and
the last group after it.
"""

import heapq
import math
from bisect import bisect_left
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

from structgstream.errors import ConfigError
from structgstream.evaluation.run_log import read_log
from structgstream.groups.track_file import read_groups
from structgstream.parallel.driver import HEADER, JOIN, TRACK
from structgstream.parallel.parts import CompletedTask, Parts, group_name


@dataclass(frozen=True)
class Costs:
    """What was measured, of one worker."""

    header_seconds: float  # frame 0, with the start of its process
    track_start_seconds: float  # of the tracking pass, until its first frame
    track_seconds: float  # of a tracked frame
    process_seconds: float  # of a group, until its first frame begins
    first_seconds: float  # what the first frame of a group takes longer than others; not that of frame 0's group
    frame_seconds: float  # of a frame fitted after another
    join_start_seconds: float  # until joining begins
    join_seconds: float  # of a joined frame
    header_bytes: float  # init record and frame 0
    first_bytes: float  # key packet that begins a group
    key_bytes: float  # another key packet
    frame_bytes: float  # another packet
    worker_bytes: float  # largest resident memory of a worker


@dataclass(frozen=True)
class Work:
    """How much there is to do. Raises ConfigError if one of them is less than 1."""

    frames: int  # of the capture
    group: int  # frames of a group
    key_interval: int  # frames from one key packet to the next

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if value < 1:
                raise ConfigError(f"{name} must be 1 or more, got {value}.")

    @property
    def groups(self) -> list[int]:
        """The length of each group."""
        full, rest = divmod(self.frames, self.group)
        return [self.group] * full + ([rest] if rest else [])


@dataclass(frozen=True)
class Estimate:
    """What a run takes."""

    workers: int  # at a time
    seconds: float  # from the beginning to the joined stream
    header_seconds: float  # of these, frame 0, alone
    tail_seconds: float  # of these, after the tracking pass: what is left of the groups
    join_seconds: float  # of these, joining, alone
    speedup: float  # against one frame after the other on one worker

    @property
    def efficiency(self) -> float:
        """Share of the workers' time that a run on one would need, too."""
        return self.speedup / self.workers


def sequential_seconds(costs: Costs, work: Work) -> float:
    """Of ``reconstruct``, one frame after the other."""
    return costs.header_seconds + (work.frames - 1) * costs.frame_seconds


def serial_seconds(costs: Costs, work: Work) -> float:
    """What no number of workers shortens; see Note [Serial part]."""
    tracking = costs.track_start_seconds + work.frames * costs.track_seconds
    return costs.header_seconds + tracking + _joining(costs, work)


def estimate(costs: Costs, work: Work, workers: int) -> Estimate:
    """A run on ``workers``: groups begin in their order, each as soon as a worker is free and the pass has come to
    it."""
    begin = costs.header_seconds
    tracking = begin + costs.track_start_seconds + work.frames * costs.track_seconds
    free = [tracking, *[begin] * (workers - 1)]  # The pass is a task like others.
    heapq.heapify(free)
    first, end = 0, tracking
    for length in work.groups:
        tracked = begin if not first else begin + costs.track_start_seconds + (first + 1) * costs.track_seconds
        # Frame 0 is in the header, so that its group has no first frame to fit.
        fitting = length * costs.frame_seconds + (costs.first_seconds if first else -costs.frame_seconds)
        done = max(heapq.heappop(free), tracked) + costs.process_seconds + fitting
        heapq.heappush(free, done)
        end, first = max(end, done), first + length
    joining = _joining(costs, work)
    total = end + joining
    speedup = sequential_seconds(costs, work) / total
    return Estimate(workers, total, costs.header_seconds, end - tracking, joining, speedup)


def workers_for(costs: Costs, work: Work, seconds: float) -> Estimate | None:
    """The least number of workers that end within ``seconds``; None if no number does."""
    numbers = range(1, len(work.groups) + 2)
    place = bisect_left(numbers, True, key=lambda workers: estimate(costs, work, workers).seconds <= seconds)
    return estimate(costs, work, numbers[place]) if place < len(numbers) else None


def stream_bytes(costs: Costs, work: Work) -> float:
    """Of the joined stream."""
    total = costs.header_bytes
    for i, length in enumerate(work.groups):
        keys = math.ceil(length / work.key_interval) - 1
        total += (costs.first_bytes if i else 0.0) + keys * costs.key_bytes + (length - 1 - keys) * costs.frame_bytes
    return total


@dataclass(frozen=True)
class Measured:
    """What a run has shown."""

    costs: Costs  # of one of its workers
    frames: int  # of the run
    groups: int  # that were measured; those that were begun more than once are not
    seconds: float  # of all its tasks together


def measured_in(folder: Path) -> Measured:
    """The costs of the run whose parts are in ``folder``.

    A group's process takes longer than its frames: that time is counted as the start of every process, of the tracking
    pass and of joining, too.

    Raises:
        ConfigError: there is no finished run, or no group of two or more frames that begins after frame 0 and was
            fitted in one attempt.
    """
    parts = Parts(folder)
    groups = [(parts.completed.get(group_name(a, b)), a, b) for a, b in read_groups(parts.track) or ()]
    if not {HEADER, TRACK, JOIN} <= parts.completed.keys() or any(task is None for task, _, _ in groups):
        raise ConfigError(
            f"{folder} has no finished parallel run; give the OUT.parts of one, or none, so that two groups are fitted."
        )
    measured = [(task, _frames(parts, a, b)) for task, a, b in groups if task is not None and task.attempts == 1 and a]
    measured = [(task, log) for task, log in measured if len(log) == task.frames]
    later = [entry for _, log in measured for entry in log[1:]]
    if not later:
        raise ConfigError(f"{folder} has no group of two frames that was fitted without a break; fit more groups.")
    process = fmean(max(task.seconds - sum(entry["total_seconds"] for entry in log), 0.0) for task, log in measured)
    first_seconds = fmean(log[0]["total_seconds"] for _, log in measured)
    frame_seconds = fmean(entry["total_seconds"] for entry in later)
    track, join, header = (parts.completed[name] for name in (TRACK, JOIN, HEADER))
    keys = [entry["bytes"] for entry in later if entry["kind"] == "key"]
    first_bytes = fmean(log[0]["bytes"] for _, log in measured)
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
        worker_bytes=max(task.peak_bytes for task in parts.completed.values()),
    )
    return Measured(costs, track.frames, len(measured), sum(task.seconds for task in parts.completed.values()))


def _start(task: CompletedTask, process: float) -> float:
    """How much of a task is the start of its process."""
    return min(process, task.seconds)


def _frames(parts: Parts, first: int, end: int) -> list[dict[str, Any]]:
    """The log of a group, in the order of its frames."""
    log = read_log(parts.segment(first, end))
    return [log[i] for i in range(first, end) if i in log]


def _joining(costs: Costs, work: Work) -> float:
    return costs.join_start_seconds + work.frames * costs.join_seconds

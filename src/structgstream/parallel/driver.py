# SPDX-License-Identifier: Apache-2.0
"""The commands of a parallel run as tasks, and its driver: header, track, each group as soon as the track has its
start, and the join.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path

from structgstream.atomic_files import atomic_write
from structgstream.errors import StorageError, StreamError, TaskError
from structgstream.executors.tasks import (
    PYTHON,
    LocalEngine,
    Task,
    TaskQueue,
    TaskResult,
    WorkerSlot,
    thread_environment,
)
from structgstream.groups.track_file import Groups, groups_path, open_track, read_groups
from structgstream.parallel.exchange import SharedFolder
from structgstream.parallel.parts import Parts, group_name, key_of, sha256_of

HEADER, TRACK, JOIN = "header", "track", "join"
PROGRAM = (PYTHON, "-m", "structgstream")


@dataclass(frozen=True)
class Unit:
    """Options of the commands."""

    capture: str  # folder of the capture
    frames: int | None = None  # number of frames; None for all
    header: tuple[str, ...] = ()  # further arguments of reconstruct for frame 0: preset, scale, held-out cameras
    track: tuple[str, ...] = ()  # further arguments of track: length of groups
    # threads of the tracking pass, which all groups wait for; None for those of its worker slot
    track_threads: int | None = None
    device: tuple[str, ...] = ()  # further arguments of all commands but join: the back-end
    join: tuple[str, ...] = ()  # further arguments of join, which runs here: the back-end, number of processes
    program: tuple[str, ...] = PROGRAM  # runs the commands

    def header_task(self, parts: Parts) -> Task:
        """Fits frame 0, which all groups share."""
        words = ("reconstruct", self.capture, "-o", str(parts.header), "--frames", "1", "--resume")
        # groups carry no sound
        return self._task(parts, HEADER, parts.header, *words, "--sound", "none", *self.header, *self.device)

    def track_task(self, parts: Parts) -> Task:
        """The tracking pass."""
        words = ("track", self.capture, "--init", str(parts.header), "-o", str(parts.track))
        count = () if self.frames is None else ("--frames", str(self.frames))
        task = self._task(parts, TRACK, parts.track, *words, *count, *self.track, *self.device)
        return task if self.track_threads is None else replace(task, environment=thread_environment(self.track_threads))

    def group_task(self, parts: Parts, first: int, end: int) -> Task:
        """Fits a group to a segment."""
        segment = parts.segment(first, end)
        words = ("fit-group", self.capture, "--init", str(parts.header), "--track", str(parts.track))
        words += ("--frames", f"{first}:{end}", "-o", str(segment))
        return self._task(parts, group_name(first, end), segment, *words, *self.device)

    def join_task(self, parts: Parts, groups: Groups, output: Path) -> Task:
        """Joins all segments to the stream."""
        segments = [str(parts.segment(first, end)) for first, end in groups]
        return self._task(parts, JOIN, output, "join", *segments, "-o", str(output), "--overwrite", *self.join)

    def _task(self, parts: Parts, name: str, result: Path, *words: str) -> Task:
        return Task(name, (*self.program, *words), str(result), parts.log(name))


POLL_SECONDS = 0.5
MESSAGE_LINES = 6  # of the output of a failed task
TAIL_CHARACTERS = 500  # by which the output of an attempt is found in a log


class State(StrEnum):
    """State of a group."""

    UNTRACKED = "waiting for the track"
    READY = "ready"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"


@dataclass(frozen=True)
class Status:
    """Progress of a run."""

    stage: str  # header, track, groups (perhaps while the track grows) or join
    groups: Groups = ()  # frames of each group, once they are known
    states: tuple[State, ...] = ()
    failed: tuple[str, ...] = ()  # names of tasks that failed


Listener = Callable[[Status], object]


@dataclass(frozen=True)
class Job:
    """A parallel run."""

    unit: Unit  # its commands
    output: Path  # the stream file
    gpus: int = 0  # number of GPUs that a task needs, 0 or 1

    @property
    def key(self) -> str:
        """Hash of the plan."""
        return key_of(self.plan)

    @property
    def plan(self) -> dict[str, object]:
        """What the parts depend on, as plain JSON values."""
        unit = self.unit
        given = {"capture": unit.capture, "frames": unit.frames, "header": unit.header}
        return {**given, "track": unit.track, "device": unit.device}


def drive(
    job: Job,
    parts: Parts,
    executor: TaskQueue,
    *,
    exchange: SharedFolder | None = None,
    listener: Listener | None = None,
) -> Groups:
    """Makes the missing parts, and joins them to ``job.output``; returns the groups.

    Call it again after an interruption: complete parts are not made again.

    Args:
        exchange: how parts are transferred; by default all machines see the folder.

    Raises:
        ConfigError: the folder has parts of another plan.
        TaskError: tasks failed; complete parts remain.
        StorageError: the parts cannot be written, or are not seen here.
    """
    parts.use_plan(job.plan)
    return _Drive(job, parts, executor, exchange or SharedFolder(), listener or (lambda status: None)).run()


class _Drive:
    """The state of :func:`drive`."""

    def __init__(self, job: Job, parts: Parts, executor: TaskQueue, exchange: SharedFolder, listener: Listener) -> None:
        self._job, self._unit, self._parts, self._executor = job, job.unit, parts, executor
        self._exchange, self._listener = exchange, listener
        self._stage, self._header_key = HEADER, ""
        self._groups: dict[str, tuple[int, int]] = {}  # by name, in order
        self._states: dict[str, State] = {}
        self._failed: list[TaskResult] = []

    def run(self) -> Groups:
        """Runs all tasks in order."""
        parts, gpus = self._parts, self._job.gpus
        task = self._unit.header_task(parts)
        made = self._alone(self._executor, self._exchange.header(task), gpus=gpus)
        self._exchange.fetch(parts.header)
        parts.record(made, key_of(task.command), parts.header, frames=1)
        self._stage, self._header_key = TRACK, sha256_of(parts.header)
        self._executor.submit(self._exchange.track(self._unit.track_task(parts)), gpus=gpus)
        is_tracked = is_lost = False
        while not is_tracked or self._executor.running or self._executor.waiting:
            for result in self._executor.wait(POLL_SECONDS):
                is_tracked |= result.name == TRACK
                is_lost |= result.name == TRACK and not result.done
                self._record(result)
            if not is_lost:
                self._submit_groups(is_tracked=is_tracked)
                if is_tracked and not self._groups:
                    raise TaskError(f"The tracking pass has ended, and there are no groups next to {parts.track}.")
            self._states |= {name: State.RUNNING for name in self._executor.running if name in self._states}
            self._show()
        if self._failed:
            raise TaskError(_sentence(self._failed, parts))
        return self._join()

    def _alone(self, queue: TaskQueue, task: Task, *, gpus: int) -> TaskResult:
        """Runs a task that all others depend on, or that depends on them."""
        self._show()
        queue.submit(task, gpus=gpus)
        while not (results := queue.wait(POLL_SECONDS)):
            self._show()
        self._store_output(results[0])
        if not results[0].done:
            raise TaskError(_sentence(results, self._parts))
        return results[0]

    def _submit_groups(self, *, is_tracked: bool) -> None:
        """Submits the groups whose start the track has, unless they are complete."""
        if not is_tracked:
            self._exchange.fetch_track()
        if not self._groups:
            self._groups = {group_name(*group): group for group in read_groups(self._parts.track) or ()}
            self._states = dict.fromkeys(self._groups, State.UNTRACKED)
            self._stage = "groups" if self._groups else self._stage
        left = [name for name, state in self._states.items() if state is State.UNTRACKED]
        starts = self._starts() if left and not is_tracked else []
        for name in left:
            first = self._groups[name][0]
            if first and not is_tracked and first not in starts:
                return
            task = self._unit.group_task(self._parts, *self._groups[name])
            if self._parts.is_complete(name, self._key(task), Path(task.result)):
                self._states[name] = State.DONE
            else:
                self._executor.submit(self._exchange.group(task, first), gpus=self._job.gpus)
                self._states[name] = State.READY

    def _starts(self) -> list[int]:
        """The starts in the growing track; none before its head is written."""
        try:
            return open_track(self._parts.track).starts
        except StreamError:
            return []

    def _key(self, task: Task) -> str:
        return key_of(task.command, self._header_key)

    def _record(self, result: TaskResult) -> None:
        self._store_output(result)
        if not result.done:
            self._failed.append(result)
        if result.name == TRACK:
            if result.done:
                self._exchange.fetch(self._parts.track)
                self._exchange.fetch(groups_path(self._parts.track))
                frames = (read_groups(self._parts.track) or [(0, 0)])[-1][1]
                self._parts.record(result, key_of(self._header_key), self._parts.track, frames=frames)
            return
        if result.done:
            first, end = self._groups[result.name]
            task = self._unit.group_task(self._parts, first, end)
            self._exchange.fetch(Path(task.result))
            self._parts.record(result, self._key(task), Path(task.result), frames=end - first)
        self._states[result.name] = State.DONE if result.done else State.FAILED

    def _store_output(self, result: TaskResult) -> None:
        """Appends the output of a task on another machine to its log here."""
        log = self._parts.log(result.name)
        try:
            stored = log.read_bytes() if log.exists() else b""
            if result.output.strip()[-TAIL_CHARACTERS:] not in stored.decode(errors="replace"):
                atomic_write(log, [stored, result.output.encode()], new_folder=True)
        except OSError as error:
            raise StorageError(f"{log} cannot be read ({error.strerror}).") from error

    def _show(self) -> None:
        failed = tuple(result.name for result in self._failed)
        self._listener(Status(self._stage, [*self._groups.values()], tuple(self._states.values()), failed))

    def _join(self) -> Groups:
        """Joins the segments in a process of this machine."""
        groups, output, self._stage = [*self._groups.values()], self._job.output, JOIN
        key = key_of([self._parts.completed[name].sha256 for name in self._groups])
        if self._parts.is_complete(JOIN, key, output):
            self._show()
            return groups
        gpus = self._job.gpus
        with TaskQueue(LocalEngine([WorkerSlot(1, 0 if gpus else None)])) as here:
            made = self._alone(here, self._unit.join_task(self._parts, groups, output), gpus=gpus)
        self._parts.record(made, key, output, frames=groups[-1][1])
        return groups


def _sentence(failed: Sequence[TaskResult], parts: Parts) -> str:
    """Which tasks failed, and the output of the first of them."""
    first = failed[0]
    output = " ".join(first.output.strip().splitlines()[-MESSAGE_LINES:]) or f"it ended with status {first.status}"
    others = f" and {len(failed) - 1} more" if len(failed) > 1 else ""
    return (
        f"The task {first.name}{others} failed: {output} (complete output: {parts.log(first.name)}). Complete parts "
        f"remain in {parts.folder}; the same command continues the run."
    )

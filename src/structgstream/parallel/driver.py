# SPDX-License-Identifier: Apache-2.0
"""Drives a parallel run: header, track, each group as soon as the track has come to it, and the joining."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path

from structgstream.atomic_files import atomic_write
from structgstream.errors import StorageError, TaskError
from structgstream.executors.executor import Executor, TaskQueue
from structgstream.executors.local import LocalEngine
from structgstream.executors.task import Task, TaskResult
from structgstream.executors.worker_slots import WorkerSlot
from structgstream.groups.group_list import Groups, groups_path, read_groups
from structgstream.parallel.exchange import SharedFolder
from structgstream.parallel.parts import Parts, group_name, key_of, sha256_of
from structgstream.parallel.unit import HEADER, JOIN, TRACK, Unit

POLL_SECONDS = 0.5
LINES_TOLD = 6
END_CHARACTERS = 500  # by which the output of an attempt is found in a log


class State(StrEnum):
    """Of a group."""

    TRACKED_LATER = "waiting for the track"
    READY = "ready"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"


@dataclass(frozen=True)
class Status:
    """How far a run is.

    Args:
        stage: what it does: header, track, groups (and perhaps the track) or join.
        groups: frames of each, once they are known.
        states: of each.
        tracked: number of groups whose beginning has been tracked.
        failed: names of tasks that failed.
    """

    stage: str
    groups: Groups = ()
    states: tuple[State, ...] = ()
    tracked: int = 0
    failed: tuple[str, ...] = ()


Listener = Callable[[Status], object]


@dataclass(frozen=True)
class Job:
    """What is to be made.

    Args:
        unit: the commands.
        output: the stream file.
        gpus: that a task needs, 0 or 1.
    """

    unit: Unit
    output: Path
    gpus: int = 0

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
    executor: Executor,
    *,
    exchange: SharedFolder | None = None,
    listener: Listener | None = None,
) -> Groups:
    """Makes what is missing of the parts, and joins them to ``job.output``; returns the groups.

    Call it again after an interruption: parts that are whole are not made again.

    Args:
        job: what is to be made.
        parts: the folder of parts, which this process holds (:meth:`Parts.held`).
        executor: runs the tasks, all but the joining, which is done here.
        exchange: how parts come here; by default all machines see the folder.
        listener: told of the state, twice a second and when something ends.

    Raises:
        TaskError: tasks failed; whole parts stay.
        StorageError: the parts cannot be written, or are not seen here.
    """
    parts.keep_to(job.plan)
    return _Drive(job, parts, executor, exchange or SharedFolder(), listener or (lambda status: None)).run()


class _Drive:
    """The state of :func:`drive`."""

    def __init__(self, job: Job, parts: Parts, executor: Executor, exchange: SharedFolder, tell: Listener) -> None:
        self._job, self._unit, self._parts, self._executor, self._tell = job, job.unit, parts, executor, tell
        self._exchange = exchange
        self._status = Status(HEADER)
        self._index: dict[str, int] = {}
        self._next = 0  # of the groups, the first that is not submitted
        self._failed: list[TaskResult] = []
        self._header_key = ""

    def run(self) -> Groups:
        """Everything, in its order."""
        self._run_alone(self._unit.header_task(self._parts), self._parts.header)
        self._header_key = sha256_of(self._parts.header)
        self._say(stage=TRACK)
        self._executor.submit(self._exchange.track(self._unit.track_task(self._parts)), gpus=self._job.gpus)
        is_tracked = False
        while not is_tracked or self._executor.running or self._executor.waiting:
            self._submit_groups(is_tracked=is_tracked)
            for ending in self._executor.wait(POLL_SECONDS):
                is_tracked |= ending.name == TRACK
                self._ended(ending)
            if any(ending.name == TRACK for ending in self._failed):
                is_tracked = True
                self._next = len(self._status.groups)
            elif is_tracked:
                self._submit_groups(is_tracked=True)
                self._check_groups()
            self._show_running()
        if self._failed:
            raise TaskError(_sentence(self._failed, self._parts))
        return self._join()

    def _run_alone(self, task: Task, part: Path) -> None:
        """Frame 0: there is nothing beside it to do."""
        self._tell(self._status)
        self._executor.submit(self._exchange.header(task), gpus=self._job.gpus)
        while not (endings := self._executor.wait(POLL_SECONDS)):
            self._tell(self._status)
        self._keep_words(endings[0])
        if not endings[0].done:
            raise TaskError(_sentence(endings, self._parts))
        self._exchange.fetch(part)
        self._parts.note(endings[0], key_of(task.command), part, frames=1)

    def _submit_groups(self, *, is_tracked: bool) -> None:
        """Those whose beginning the track has."""
        if not is_tracked:
            self._exchange.follow()
        if not self._status.groups:
            groups = read_groups(self._parts.track)
            if groups is None:
                return
            self._index = {group_name(*group): i for i, group in enumerate(groups)}
            self._say(stage="groups", groups=groups, states=(State.TRACKED_LATER,) * len(groups))
        groups, states = self._status.groups, list(self._status.states)
        if self._next == len(groups):
            return
        starts = None if is_tracked else {0, *self._unit.starts(self._parts.track)}
        while self._next < len(groups) and (starts is None or groups[self._next][0] in starts):
            task = self._unit.group_task(self._parts, *groups[self._next])
            if self._parts.is_whole(task.name, self._key(task), Path(task.result)):
                states[self._next] = State.DONE
            else:
                self._executor.submit(self._exchange.group(task, groups[self._next][0]), gpus=self._job.gpus)
                states[self._next] = State.READY
            self._next += 1
        self._say(states=tuple(states), tracked=self._next)

    def _check_groups(self) -> None:
        if not self._status.groups:
            raise TaskError(f"The tracking pass has ended, and there are no groups beside {self._parts.track}.")

    def _key(self, task: Task) -> str:
        return key_of(task.command, self._header_key)

    def _ended(self, ending: TaskResult) -> None:
        self._keep_words(ending)
        if not ending.done:
            self._failed.append(ending)
            self._say(failed=tuple(failed.name for failed in self._failed))
        if ending.name == TRACK:
            if ending.done:
                self._exchange.fetch(self._parts.track)
                self._exchange.fetch(groups_path(self._parts.track))
                frames = (read_groups(self._parts.track) or [(0, 0)])[-1][1]
                self._parts.note(ending, key_of(self._header_key), self._parts.track, frames=frames)
            return
        first, end = self._status.groups[self._index[ending.name]]
        if ending.done:
            task = self._unit.group_task(self._parts, first, end)
            self._exchange.fetch(Path(task.result))
            self._parts.note(ending, self._key(task), Path(task.result), frames=end - first)
        self._mark({ending.name: State.DONE if ending.done else State.FAILED})

    def _keep_words(self, ending: TaskResult) -> None:
        """What a task on another machine has printed is kept here."""
        log = self._parts.log(ending.name)
        try:
            there = log.read_bytes() if log.exists() else b""
            if ending.output.strip()[-END_CHARACTERS:] not in there.decode(errors="replace"):
                atomic_write(log, [there, ending.output.encode()], new_folder=True)
        except OSError as error:
            raise StorageError(f"{log} cannot be read ({error.strerror}).") from error

    def _show_running(self) -> None:
        self._mark({name: State.RUNNING for name in self._executor.running if name in self._index})
        self._tell(self._status)

    def _mark(self, new: dict[str, State]) -> None:
        states = list(self._status.states)
        for name, state in new.items():
            states[self._index[name]] = state
        self._say(states=tuple(states))

    def _join(self) -> Groups:
        """Here, where the output is."""
        groups, output = self._status.groups, self._job.output
        self._say(stage=JOIN)
        self._tell(self._status)
        task = self._unit.join_task(self._parts, groups, output)
        key = key_of([self._parts.notes[group_name(*group)].sha256 for group in groups])
        if self._parts.is_whole(JOIN, key, output):
            return groups
        with TaskQueue(LocalEngine([WorkerSlot(1)])) as here:
            here.submit(task)
            while not (endings := here.wait(POLL_SECONDS)):
                self._tell(self._status)
        if not endings[0].done:
            raise TaskError(_sentence(endings, self._parts))
        self._parts.note(endings[0], key, output, frames=groups[-1][1])
        return groups

    def _say(self, **changes: object) -> None:
        self._status = replace(self._status, **changes)  # type: ignore[arg-type]


def _sentence(failed: Iterable[TaskResult], parts: Parts) -> str:
    """Which tasks failed, and what the first of them said."""
    failed = list(failed)
    first = failed[0]
    said = " ".join(first.output.strip().splitlines()[-LINES_TOLD:]) or f"it ended with status {first.status}"
    others = f" and {len(failed) - 1} more" if len(failed) > 1 else ""
    return (
        f"The task {first.name}{others} failed: {said} (all of it: {parts.log(first.name)}). What is whole is kept in "
        f"{parts.folder}; the same command goes on."
    )

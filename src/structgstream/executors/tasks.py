# SPDX-License-Identifier: Apache-2.0
"""Tasks: commands that may be repeated at any time; the queue that orders them, and engines that run them.

The engine ``local`` runs each task as a process of this machine, one at a time in each worker slot, and stops it
together with its child processes. The engine ``ray`` is in ``ray_cluster``.
"""

import os
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import BinaryIO, Literal, Protocol

from structgstream.errors import ConfigError
from structgstream.executors import launch

PYTHON = "{python}"
"""First word of a command that stands for the Python interpreter of the machine that runs it."""
TAIL_BYTES = 4000
"""Number of bytes of a task's output that its result contains."""


@dataclass(frozen=True)
class Task:
    """A command with a result.

    It must be idempotent: restarted after it was killed, or run twice at the same time, it has the same result, which
    it writes atomically.
    """

    name: str  # a name that is unique in an executor, usable as a file name
    command: tuple[str, ...]  # the argument vector; the first word may be PYTHON
    result: str = ""  # path or URL of its result; frames are not transferred in any other way
    log: Path | None = None  # its output is appended to this file; None discards all but the last TAIL_BYTES
    # variables to set, in addition to those of its worker slot
    environment: Mapping[str, str] = field(default_factory=dict)
    retries: int = 5  # number of restarts after it was killed. A command that fails by itself is not repeated.


@dataclass(frozen=True)
class TaskResult:
    """The result of a task."""

    name: str  # name of the task
    status: int  # exit status of the command; the negative signal number if a signal ended it
    seconds: float = 0.0  # duration of the last attempt
    attempts: int = 1  # number of attempts
    peak_bytes: int = 0  # largest resident memory of the command; 0 if unknown
    output: str = ""  # the end of its output

    @property
    def done(self) -> bool:
        """Whether the command succeeded."""
        return self.status == 0

    @property
    def killed(self) -> bool:
        """Whether a signal ended it."""
        return self.status < 0


def tied_argv(command: tuple[str, ...]) -> list[str]:
    """The argument vector on this machine of a process that is killed when this one ends (``launch.py``)."""
    first = sys.executable if command[0] == PYTHON else command[0]
    return [sys.executable, "-I", "-S", launch.__file__, str(os.getpid()), first, *command[1:]]


_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")


@dataclass(frozen=True)
class WorkerSlot:
    """A worker slot, which runs one task at a time: a number of threads, and the index of its GPU, if it has one, among
    those that this process sees."""

    threads: int
    gpu: int | None = None

    def environment(self, *, gpus: int = 0) -> Mapping[str, str]:
        """Environment variables of a task that uses ``gpus`` GPUs, 0 or 1."""
        variable, seen = "CUDA_VISIBLE_DEVICES", ""
        if gpus and self.gpu is not None:
            visible = os.environ.get(variable)
            seen = str(self.gpu) if visible is None else visible.split(",")[self.gpu].strip()
        return thread_environment(self.threads) | {variable: seen}


def thread_environment(threads: int) -> dict[str, str]:
    """Environment variables that set the number of threads of libraries."""
    return dict.fromkeys(_THREADS, str(threads))


def allocate_slots(
    *, workers: int | None, cores: int, gpus: int = 0, threads: int | None = None
) -> tuple[WorkerSlot, ...]:
    """Slots for ``workers`` concurrent tasks, which use GPUs in turn; by default one per GPU, or one per core without
    GPUs. Each has ``threads``, or its share of the cores, at least one. Raises ConfigError if there is less than one of
    either."""
    for name, value in (("workers", workers), ("threads", threads)):
        if value is not None and value < 1:
            raise ConfigError(f"The number of {name} must be 1 or more, got {value}.")
    count = workers or gpus or cores
    share = max(1, cores // count) if threads is None else threads
    return tuple(WorkerSlot(share, number % gpus if gpus else None) for number in range(count))


ENDING_SECONDS = 10.0
"""Time in which a command may end by itself; then it is killed, which does not damage complete results."""


class CommandProcess:
    """The running command of a task. It is killed when this process ends."""

    def __init__(self, task: Task, *, environment: Mapping[str, str]) -> None:
        self.name = task.name
        self._log = opened_log(task.log)
        self._began_at = self._log.tell()
        self._started = time.monotonic()
        self._process = subprocess.Popen(
            tied_argv(task.command),
            stdin=subprocess.DEVNULL,
            stdout=self._log,
            stderr=self._log,
            env={**os.environ, **environment, **task.environment},
            start_new_session=True,  # Ctrl-C must reach only this process, which stops the others.
        )
        self.descriptor = os.pidfd_open(self._process.pid)

    @property
    def pid(self) -> int:
        """Process id of the command."""
        return self._process.pid

    def ended(self) -> TaskResult | None:
        """Its result; None while it runs. Must not be called again after it has returned a result."""
        if os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None:
            return None
        self._kill()  # Kills remaining child processes while the process id is still reserved.
        _, status, usage = os.wait4(self.pid, 0)
        self._process.returncode = code = os.waitstatus_to_exitcode(status)
        os.close(self.descriptor)
        seconds = time.monotonic() - self._started
        with self._log:
            output = tail_of(self._log, self._began_at)
        return TaskResult(self.name, code, seconds, peak_bytes=usage.ru_maxrss * 1024, output=output)

    def ask(self) -> None:
        """Sends SIGTERM to the process group."""
        with suppress(ProcessLookupError):
            os.killpg(self.pid, signal.SIGTERM)

    def stop(self) -> None:
        """Asks the command to end, then kills it and its child processes."""
        self.ask()
        waited_for([self], ENDING_SECONDS)
        self._kill()
        waited_for([self], ENDING_SECONDS)
        self.ended()

    def _kill(self) -> None:
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(self.pid, signal.SIGKILL)


def waited_for(processes: Sequence[CommandProcess], seconds: float) -> bool:
    """Waits up to ``seconds`` for one of the processes to end; returns whether one has."""
    poll = select.poll()
    for process in processes:
        poll.register(process.descriptor, select.POLLIN)
    return bool(poll.poll(round(seconds * 1000)))


def opened_log(log: Path | None) -> BinaryIO:
    """The log opened for appending; a temporary file if ``log`` is None."""
    if log is None:
        return tempfile.TemporaryFile()
    log.parent.mkdir(parents=True, exist_ok=True)
    file = log.open("ab+")
    file.seek(0, os.SEEK_END)
    return file


def tail_of(file: BinaryIO, begin: int) -> str:
    """The last :data:`TAIL_BYTES` of what was written from byte ``begin`` on."""
    end = file.seek(0, os.SEEK_END)
    file.seek(max(begin, end - TAIL_BYTES))
    return file.read().decode(errors="replace")


class LocalEngine:
    """Processes in slots: shares of the cores, or GPUs (:func:`allocate_slots`)."""

    def __init__(self, slots: Sequence[WorkerSlot]) -> None:
        self._free = list(slots)
        self._has_gpu = any(slot.gpu is not None for slot in slots)
        self._running: dict[str, tuple[CommandProcess, WorkerSlot]] = {}

    @property
    def processes(self) -> dict[str, int]:
        """Process ids of the running tasks by their names."""
        return {name: process.pid for name, (process, _) in self._running.items()}

    def check(self, gpus: int) -> None:
        if gpus > 1 or (gpus and not self._has_gpu):
            raise ConfigError(f"A task needs {gpus} GPUs, and a worker here has {int(self._has_gpu)}.")

    def has_room(self, gpus: int) -> bool:
        return any(slot.gpu is not None for slot in self._free) if gpus else bool(self._free)

    def start(self, task: Task, *, gpus: int) -> None:
        # A task without a GPU prefers a slot without one.
        slot = min(self._free, key=lambda slot: (slot.gpu is None) == bool(gpus))
        self._free.remove(slot)
        self._running[task.name] = (CommandProcess(task, environment=slot.environment(gpus=gpus)), slot)

    def ended(self, seconds: float) -> list[TaskResult]:
        waited_for([process for process, _ in self._running.values()], seconds)
        results = []
        for name, (process, slot) in list(self._running.items()):
            if (result := process.ended()) is not None:
                del self._running[name]
                self._free.append(slot)
                results.append(result)
        return results

    def stop(self) -> None:
        """See ``Engine.stop``; all tasks are asked to end at the same time."""
        for process, slot in self._running.values():
            process.ask()
            self._free.append(slot)
        for process, _ in self._running.values():
            process.stop()
        self._running.clear()


class Engine(Protocol):
    """Runs tasks that are ready, each once."""

    def check(self, gpus: int) -> None:
        """Raises ConfigError if a task that needs ``gpus`` GPUs would never run."""
        ...

    def has_room(self, gpus: int) -> bool:
        """Whether a task that needs ``gpus`` GPUs can be started now."""
        ...

    def start(self, task: Task, *, gpus: int) -> None:
        """Starts a task; there must be room for it."""
        ...

    def ended(self, seconds: float) -> list[TaskResult]:
        """Waits up to ``seconds`` for a task to end; returns the results of all that have ended."""
        ...

    def stop(self) -> None:
        """Stops running tasks and releases resources."""
        ...


class TaskQueue:
    """Runs tasks on an engine in the order of their submission, and restarts killed ones first."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._tasks: dict[str, tuple[Task, int]] = {}  # tasks that have not ended, with their number of GPUs
        self._ready: deque[str] = deque()
        self._running: set[str] = set()
        self._attempts: dict[str, int] = {}

    def __enter__(self) -> "TaskQueue":
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()

    @property
    def running(self) -> Sequence[str]:
        """Names of the tasks that the engine runs."""
        return tuple(self._running)

    @property
    def waiting(self) -> Sequence[str]:
        """Names of the tasks that wait to be started, or to be restarted after they were killed."""
        return tuple(self._ready)

    def submit(self, task: Task, *, gpus: int = 0) -> None:
        """Adds a task with a name of its own, which is started in :meth:`wait`; it may need one GPU. Raises ConfigError
        if the name is taken, or there is no GPU."""
        if task.name in self._tasks:
            raise ConfigError(f"There are two tasks with the name {task.name!r}.")
        self.engine.check(gpus)
        self._tasks[task.name] = (task, gpus)
        self._ready.append(task.name)

    def wait(self, seconds: float) -> Sequence[TaskResult]:
        """Starts tasks, waits up to ``seconds`` for one to end, and returns the results."""
        self._begin()
        if not self._running:
            return ()
        results = []
        for result in self.engine.ended(seconds):
            self._running.remove(result.name)
            task, _ = self._tasks[result.name]
            if result.killed and self._attempts[result.name] <= task.retries:
                self._ready.appendleft(result.name)
                continue
            del self._tasks[result.name]
            results.append(replace(result, attempts=self._attempts.pop(result.name)))
        self._begin()
        return results

    def close(self) -> None:
        """Stops running tasks, as the end of a ``with`` block does."""
        self.engine.stop()
        self._running.clear()

    def _begin(self) -> None:
        """Starts tasks while there is room; may overtake tasks that wait for a GPU."""
        passed = deque[str]()
        while self._ready and (self.engine.has_room(0) or self.engine.has_room(1)):
            name = self._ready.popleft()
            task, gpus = self._tasks[name]
            if not self.engine.has_room(gpus):
                passed.append(name)
                continue
            self._attempts[name] = self._attempts.get(name, 0) + 1
            self._running.add(name)
            self.engine.start(task, gpus=gpus)
        self._ready.extendleft(reversed(passed))


ExecutorName = Literal["local", "ray"]


@dataclass(frozen=True)
class ExecutorOptions:
    """Options of an executor."""

    name: ExecutorName = "local"  # local: processes of this machine; ray: a Ray cluster
    # number of concurrent tasks; None for one per GPU, or one per core. An existing cluster has its own number.
    workers: int | None = None
    threads: int | None = None  # threads of each worker; None for its share of the cores, and 1 on an existing cluster
    address: str | None = None  # address of the Ray cluster; None starts one on this machine


def open_executor(options: ExecutorOptions, *, cores: int, gpus: int = 0) -> TaskQueue:
    """The executor, on this many cores and GPUs of this machine; use it as a context manager.

    Raises ConfigError if there is less than one worker or thread, or the cluster cannot be joined, and
    MissingExtraError if a package is missing.
    """
    slots = allocate_slots(workers=options.workers, cores=cores, gpus=gpus, threads=options.threads)
    if options.name == "local":
        return TaskQueue(LocalEngine(slots))
    from structgstream.executors.ray_cluster import RayEngine

    threads = options.threads or (1 if options.address else slots[0].threads)
    return TaskQueue(RayEngine(options.address, len(slots), threads))

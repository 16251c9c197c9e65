# SPDX-License-Identifier: Apache-2.0
"""The task queue, the protocol of the engines that run its tasks, and the engines by name."""

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, Protocol

from structgstream.errors import ConfigError
from structgstream.executors.local import LocalEngine
from structgstream.executors.task import Task, TaskResult, allocate_slots


class Engine(Protocol):
    """Runs tasks whose dependencies are done."""

    @property
    def name(self) -> str:
        """Name of the engine, for messages."""
        ...

    @property
    def repeats(self) -> bool:
        """Whether the engine itself restarts tasks that were killed."""
        ...

    def check(self, gpus: int) -> None:
        """Check that a task that needs ``gpus`` GPUs can run.

        Raises:
            ConfigError: it would never run.
        """
        ...

    def has_room(self, gpus: int) -> bool:
        """Whether a task that needs ``gpus`` GPUs can be started now."""
        ...

    def start(self, task: Task, *, gpus: int, attempt: int) -> None:
        """Starts a task; there must be room for it."""
        ...

    def ended(self, seconds: float) -> list[TaskResult]:
        """Waits up to ``seconds`` for a task to end; returns the results of all that have ended."""
        ...

    def stop(self) -> None:
        """Stops running tasks and releases resources."""
        ...


class TaskQueue:
    """Runs each task on an engine as soon as its dependencies are done, and restarts killed ones.

    Tasks are started in the order in which they become ready; among equals, those submitted earlier first.
    """

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._tasks: dict[str, tuple[Task, int]] = {}  # tasks that have not ended, with their number of GPUs
        self._missing: dict[str, set[str]] = {}
        self._followers: dict[str, list[str]] = {}
        self._ready: deque[str] = deque()
        self._running: set[str] = set()
        self._attempts: dict[str, int] = {}
        self._done: set[str] = set()

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
        """Names of the tasks that have not started; if none is running, they depend on a failed task."""
        return tuple(name for name in self._tasks if name not in self._running)

    def submit(self, task: Task, *, after: Iterable[str] = (), gpus: int = 0) -> None:
        """Adds a task, which is started in :meth:`wait`.

        Args:
            after: names of tasks that must succeed first; they may be submitted later.
            gpus: number of GPUs that it needs, 0 or 1.

        Raises:
            ConfigError: the name is taken, or there is no GPU.
        """
        if task.name in self._tasks or task.name in self._done:
            raise ConfigError(f"There are two tasks with the name {task.name!r}.")
        self.engine.check(gpus)
        self._tasks[task.name] = (task, gpus)
        missing = {name for name in after if name not in self._done}
        if not missing:
            self._ready.append(task.name)
            return
        self._missing[task.name] = missing
        for name in missing:
            self._followers.setdefault(name, []).append(task.name)

    def finished(self, name: str) -> None:
        """Marks a task as done that was not submitted, for the tasks that depend on it."""
        self._done.add(name)
        for follower in self._followers.pop(name, ()):
            missing = self._missing[follower]
            missing.discard(name)
            if not missing:
                del self._missing[follower]
                self._ready.append(follower)

    def wait(self, seconds: float) -> Sequence[TaskResult]:
        """Starts tasks that are ready, waits up to ``seconds`` for a task to end, and returns the results."""
        self._begin()
        if not self._running:
            return ()
        results = []
        for result in self.engine.ended(seconds):
            self._running.remove(result.name)
            task, _ = self._tasks[result.name]
            if result.killed and not self.engine.repeats and self._attempts[result.name] <= task.retries:
                self._ready.appendleft(result.name)
                continue
            del self._tasks[result.name]
            attempts = self._attempts.pop(result.name)
            if result.done:
                self.finished(result.name)
            results.append(result if self.engine.repeats else replace(result, attempts=attempts))
        self._begin()
        return results

    def close(self) -> None:
        """Stops running tasks, as the end of a ``with`` block does."""
        self.engine.stop()
        self._running.clear()

    def _begin(self) -> None:
        """Starts ready tasks while there is room; may overtake tasks that wait for a GPU."""
        passed = deque[str]()
        while self._ready and (self.engine.has_room(0) or self.engine.has_room(1)):
            name = self._ready.popleft()
            task, gpus = self._tasks[name]
            if not self.engine.has_room(gpus):
                passed.append(name)
                continue
            self._attempts[name] = self._attempts.get(name, 0) + 1
            self._running.add(name)
            self.engine.start(task, gpus=gpus, attempt=self._attempts[name])
        self._ready.extendleft(reversed(passed))


ExecutorName = Literal["local", "ray"]


@dataclass(frozen=True)
class ExecutorOptions:
    """Options of an executor."""

    name: ExecutorName = "local"  # local: processes of this machine; ray: a Ray cluster
    # number of concurrent tasks; None for one per GPU, or one per core. An existing cluster has its own number.
    workers: int | None = None
    threads: int | None = None  # threads of each worker; None for its share of the cores, and 1 on a cluster
    address: str | None = None  # address of the Ray cluster; None starts one on this machine


def open_executor(options: ExecutorOptions, *, cores: int, gpus: int = 0) -> TaskQueue:
    """The executor; use it as a context manager.

    Args:
        cores: number of cores of this machine that may be used.
        gpus: number of GPUs of this machine that may be used.

    Raises:
        ConfigError: there is less than one worker or thread, or the cluster cannot be joined.
        MissingExtraError: a package is missing.
    """
    slots = allocate_slots(workers=options.workers, cores=cores, gpus=gpus, threads=options.threads)
    if options.name == "local":
        return TaskQueue(LocalEngine(slots))
    from structgstream.executors.ray_cluster import RayEngine, RayOptions

    threads = options.threads or (1 if options.address else slots[0].threads)
    return TaskQueue(RayEngine(RayOptions(options.address, len(slots), threads)))

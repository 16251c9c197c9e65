# SPDX-License-Identifier: Apache-2.0
"""What runs tasks: the protocol that callers see, that of an engine below it, and the queue between them."""

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import replace
from types import TracebackType
from typing import Protocol

from structgstream.errors import ConfigError
from structgstream.executors.task import Ending, Task


class Executor(Protocol):
    """Runs tasks as soon as those that they come after are done. A ``with`` block ends what still runs."""

    def submit(self, task: Task, *, after: Iterable[str] = (), gpus: int = 0) -> None:
        """Takes a task; it is begun in :meth:`wait`.

        Args:
            task: with a name that no other has.
            after: names of tasks that must end well before it; they may be submitted later.
            gpus: how many it needs, 0 or 1.

        Raises:
            ConfigError: the name is taken, or there is no GPU.
        """
        ...

    def finished(self, name: str) -> None:
        """Counts a task as done that is not submitted, for those that come after it."""
        ...

    def wait(self, seconds: float) -> Sequence[Ending]:
        """Begins what can be begun, waits for at most ``seconds`` until a task has ended, and tells which did."""
        ...

    @property
    def running(self) -> Sequence[str]:
        """Names of the tasks that were handed to the engine and have not ended."""
        ...

    @property
    def waiting(self) -> Sequence[str]:
        """Names of the tasks that have not begun; with nothing running, those that wait for one that failed."""
        ...

    def close(self) -> None:
        """Ends what runs."""
        ...

    def __enter__(self) -> "Executor": ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


class Engine(Protocol):
    """Runs tasks that may run now."""

    @property
    def name(self) -> str:
        """Of the kind, for messages."""
        ...

    @property
    def repeats(self) -> bool:
        """Whether it begins tasks again itself that were killed."""
        ...

    def check(self, gpus: int) -> None:
        """Raises ConfigError if a task that needs ``gpus`` GPUs would never run."""
        ...

    def has_room(self, gpus: int) -> bool:
        """Whether it takes a task now that needs ``gpus`` GPUs."""
        ...

    def start(self, task: Task, *, gpus: int, attempt: int) -> None:
        """Begins a task; there must be room."""
        ...

    def ended(self, seconds: float) -> list[Ending]:
        """Waits for at most so long until one has ended; those that have."""
        ...

    def stop(self) -> None:
        """Ends what runs, and gives back what the engine holds."""
        ...


class TaskQueue:
    """An :class:`Executor` over an engine: which tasks may run, which come next, and which are begun again.

    Tasks are begun in the order in which they become ready, those submitted earlier first.
    """

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._tasks: dict[str, tuple[Task, int]] = {}  # with the GPUs that they need, until they end
        self._missing: dict[str, set[str]] = {}
        self._followers: dict[str, list[str]] = {}
        self._ready: deque[str] = deque()
        self._running: set[str] = set()
        self._attempts: dict[str, int] = {}
        self._done: set[str] = set()

    def __enter__(self) -> "TaskQueue":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def running(self) -> Sequence[str]:
        """See :meth:`Executor.running`."""
        return tuple(self._running)

    @property
    def waiting(self) -> Sequence[str]:
        """See :meth:`Executor.waiting`."""
        return tuple(name for name in self._tasks if name not in self._running)

    def submit(self, task: Task, *, after: Iterable[str] = (), gpus: int = 0) -> None:
        """See :meth:`Executor.submit`."""
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
        """See :meth:`Executor.finished`."""
        self._done.add(name)
        for follower in self._followers.pop(name, ()):
            missing = self._missing[follower]
            missing.discard(name)
            if not missing:
                del self._missing[follower]
                self._ready.append(follower)

    def wait(self, seconds: float) -> Sequence[Ending]:
        """See :meth:`Executor.wait`."""
        self._begin()
        if not self._running:
            return ()
        told = []
        for ending in self.engine.ended(seconds):
            self._running.remove(ending.name)
            task, _ = self._tasks[ending.name]
            if ending.killed and not self.engine.repeats and self._attempts[ending.name] <= task.retries:
                self._ready.appendleft(ending.name)
                continue
            del self._tasks[ending.name]
            attempts = self._attempts.pop(ending.name)
            if ending.done:
                self.finished(ending.name)
            told.append(ending if self.engine.repeats else replace(ending, attempts=attempts))
        self._begin()
        return told

    def close(self) -> None:
        """See :meth:`Executor.close`."""
        self.engine.stop()
        self._running.clear()

    def _begin(self) -> None:
        """Begins what is ready while there is room, past tasks that wait for a GPU."""
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

# SPDX-License-Identifier: Apache-2.0
"""The engine ``local``: each task is a process of this machine, one at a time in each worker slot."""

from collections.abc import Sequence

from structgstream.errors import ConfigError
from structgstream.executors.process import CommandProcess, waited_for
from structgstream.executors.task import Task, TaskResult
from structgstream.executors.worker_slots import WorkerSlot


class LocalEngine:
    """Processes in slots: shares of the cores, or GPUs (``worker_slots.allocate_slots``)."""

    name = "local"
    repeats = False

    def __init__(self, slots: Sequence[WorkerSlot]) -> None:
        self._free = list(slots)
        self._has_gpu = any(slot.gpu is not None for slot in slots)
        self._running: dict[str, tuple[CommandProcess, WorkerSlot]] = {}

    @property
    def processes(self) -> dict[str, int]:
        """Process ids of the running tasks by their names."""
        return {name: process.pid for name, (process, _) in self._running.items()}

    def check(self, gpus: int) -> None:
        """See ``Engine.check``."""
        if gpus > 1 or (gpus and not self._has_gpu):
            raise ConfigError(f"A task needs {gpus} GPUs, and a worker here has {int(self._has_gpu)}.")

    def has_room(self, gpus: int) -> bool:
        """See ``Engine.has_room``."""
        return any(slot.gpu is not None for slot in self._free) if gpus else bool(self._free)

    def start(self, task: Task, *, gpus: int, attempt: int) -> None:
        """See ``Engine.start``."""
        # A task without a GPU prefers a slot without one.
        order = sorted(self._free, key=lambda slot: (slot.gpu is None) == bool(gpus))
        slot = order[0]
        self._free.remove(slot)
        self._running[task.name] = (CommandProcess(task, environment=slot.environment(gpus=gpus)), slot)

    def ended(self, seconds: float) -> list[TaskResult]:
        """See ``Engine.ended``."""
        waited_for([process for process, _ in self._running.values()], seconds)
        results = []
        for name, (process, slot) in list(self._running.items()):
            result = process.ended()
            if result is not None:
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

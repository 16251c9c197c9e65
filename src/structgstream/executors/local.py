# SPDX-License-Identifier: Apache-2.0
"""The engine ``local``: each task is a process of this machine, one at a time in each worker slot."""

from collections.abc import Sequence

from structgstream.errors import ConfigError
from structgstream.executors.places import Place
from structgstream.executors.process import CommandProcess, waited_for
from structgstream.executors.task import Ending, Task


class LocalEngine:
    """Processes in places: shares of the cores, or GPUs (``places.shared_out``)."""

    name = "local"
    repeats = False

    def __init__(self, places: Sequence[Place]) -> None:
        self._free = list(places)
        self._has_gpu = any(place.gpu is not None for place in places)
        self._running: dict[str, tuple[CommandProcess, Place]] = {}

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
        return any(place.gpu is not None for place in self._free) if gpus else bool(self._free)

    def start(self, task: Task, *, gpus: int, attempt: int) -> None:
        """See ``Engine.start``."""
        # A task without a GPU prefers a slot without one.
        order = sorted(self._free, key=lambda place: (place.gpu is None) == bool(gpus))
        place = order[0]
        self._free.remove(place)
        self._running[task.name] = (CommandProcess(task, environment=place.environment(gpus=gpus)), place)

    def ended(self, seconds: float) -> list[Ending]:
        """See ``Engine.ended``."""
        waited_for([process for process, _ in self._running.values()], seconds)
        results = []
        for name, (process, place) in list(self._running.items()):
            result = process.ended()
            if result is not None:
                del self._running[name]
                self._free.append(place)
                results.append(result)
        return results

    def stop(self) -> None:
        """See ``Engine.stop``; all tasks are asked to end at the same time."""
        for process, place in self._running.values():
            process.ask()
            self._free.append(place)
        for process, _ in self._running.values():
            process.stop()
        self._running.clear()

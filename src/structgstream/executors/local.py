# SPDX-License-Identifier: Apache-2.0
"""The engine ``local``: each task is a process of this machine, one at a time in each worker slot.

A process is stopped together with its child processes.
"""

import os
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

from structgstream.errors import ConfigError
from structgstream.executors import launch
from structgstream.executors.task import TAIL_BYTES, Task, TaskResult, WorkerSlot, argv_of

ENDING_SECONDS = 10.0
"""Time in which a command may end by itself; then it is killed, which does not damage complete results."""


class CommandProcess:
    """The running command of a task. It is killed when this process ends."""

    def __init__(self, task: Task, *, environment: Mapping[str, str]) -> None:
        self.name = task.name
        self._log = opened_log(task.log)
        self._began_at = self._log.tell()
        self._started = time.monotonic()
        tied = [sys.executable, "-I", "-S", str(Path(launch.__file__)), str(os.getpid())]
        self._process = subprocess.Popen(
            [*tied, *argv_of(task.command)],
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

    def ended(self, *, attempts: int = 1) -> TaskResult | None:
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
        return TaskResult(self.name, code, seconds, attempts, usage.ru_maxrss * 1024, output)

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
    """Processes in slots: shares of the cores, or GPUs (``task.allocate_slots``)."""

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

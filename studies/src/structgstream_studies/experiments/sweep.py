# SPDX-License-Identifier: Apache-2.0
"""Runs many tasks on the available cores or GPUs; finished tasks are skipped, so a sweep can be resumed."""

import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.process import BaseProcess
from pathlib import Path

from structgstream.errors import ConfigError
from structgstream.evaluation.environment import usable_cores
from structgstream.kernels.backend import BackendName
from structgstream_studies.experiments.worker import Task, WorkerSlot, work

POLL_SECONDS = 0.5
ENDING_SECONDS = 10.0


@dataclass(frozen=True)
class Progress:
    """How far a sweep is: names of running tasks with the frames they have stored, and counts of tasks."""

    running: dict[str, tuple[int, int]]
    finished: int
    total: int
    failed: tuple[str, ...]


Listener = Callable[[Progress], None]


@dataclass(frozen=True)
class Outcome:
    """Names of the tasks that failed, and of those that waited for them."""

    failed: tuple[str, ...]
    blocked: tuple[str, ...]
    skipped: tuple[str, ...]


def worker_slots(device: BackendName, *, jobs: int | None) -> list[WorkerSlot]:
    """Places to compute at: one for each GPU, or ``jobs`` shares of the cores (default: one core each).

    Raises:
        ConfigError: ``jobs`` is less than 1.
    """
    import torch

    if jobs is not None and jobs < 1:
        raise ConfigError(f"The number of jobs must be 1 or more, got {jobs}.")
    gpus = torch.cuda.device_count() if device in ("auto", "cuda") else 0
    count = jobs or gpus or usable_cores()
    threads = max(1, usable_cores() // count)
    return [WorkerSlot(device, threads, number % gpus if gpus else None) for number in range(count)]


def unique(tasks: Iterable[Task]) -> list[Task]:
    """Each task once: experiments share first frames and the full method."""
    return list({task.name: task for task in tasks}.values())


def sweep(
    tasks: Sequence[Task], seats: Sequence[WorkerSlot], *, logs: Path, listener: Listener | None = None
) -> Outcome:
    """Does every task that is not done, each in its own process, as soon as those that it needs are done.

    Args:
        tasks: with distinct names, in an order in which each follows the tasks that it needs.
        seats: one task at a time runs on each.
        logs: folder for what the tasks print, ``NAME.txt`` each.
        listener: called twice a second.

    Raises:
        KeyboardInterrupt: after the running tasks have ended; their stored frames are kept for resuming.
    """
    skipped = {task.name for task in tasks if task.done()}
    waiting = {task.name: task for task in tasks if task.name not in skipped}
    finished, failed = set(skipped), list[str]()
    free, running = list(seats), dict[str, tuple[BaseProcess, WorkerSlot, Task]]()
    context = get_context("spawn")  # torch's threads do not survive a fork
    try:
        while True:
            for name in [name for name, task in waiting.items() if finished.issuperset(task.needs)]:
                if not free:
                    break
                task, seat = waiting.pop(name), free.pop(0)
                process = context.Process(target=work, args=(task, seat, logs / f"{name}.txt"), name=name)
                process.start()
                running[name] = (process, seat, task)
            if not running:
                return Outcome(tuple(failed), tuple(waiting), tuple(sorted(skipped)))
            time.sleep(POLL_SECONDS)
            for name, (process, seat, _) in list(running.items()):
                if process.is_alive():
                    continue
                del running[name]
                free.append(seat)
                if process.exitcode == 0:
                    finished.add(name)
                else:
                    failed.append(name)
            if listener is not None:
                stored = {name: (_stored(task.stream), task.frames) for name, (_, _, task) in running.items()}
                listener(Progress(stored, len(finished), len(tasks), tuple(failed)))
    finally:
        _end(process for process, _, _ in running.values())


def _stored(stream: Path) -> int:
    """How many frames a running task has logged."""
    from structgstream.evaluation.run_log import log_path

    try:
        with log_path(stream).open() as file:
            return sum(1 for _ in file)
    except OSError:
        return 0


def _end(processes: Iterable[BaseProcess]) -> None:
    """Asks politely, then not: streams are whole after every frame either way."""
    ending = list(processes)
    for process in ending:
        with suppress(OSError):
            process.terminate()
    for process in ending:
        process.join(ENDING_SECONDS)
        if process.is_alive():
            process.kill()

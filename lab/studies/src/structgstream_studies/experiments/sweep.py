# SPDX-License-Identifier: Apache-2.0
"""Runs the tasks of an experiment by an executor; finished tasks are skipped, so a sweep can be resumed."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from structgstream.evaluation.environment import usable_cores
from structgstream.executors import tasks as executors
from structgstream.executors.tasks import ExecutorOptions, TaskQueue, open_executor
from structgstream.kernels.backend import BackendName
from structgstream_studies.experiments.worker import Task, command_of

POLL_SECONDS = 0.5


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


def gpus_of(device: BackendName) -> int:
    """How many GPUs of this machine tasks on ``device`` use."""
    import torch

    return torch.cuda.device_count() if device in ("auto", "cuda") else 0


def executor_for(device: BackendName, options: ExecutorOptions) -> TaskQueue:
    """What runs the tasks: by default a process for each GPU, or for each core.

    Raises:
        ConfigError: less than one worker, or a cluster that cannot be joined.
        MissingExtraError: a package is missing.
    """
    return open_executor(options, cores=usable_cores(), gpus=gpus_of(device))


def unique(tasks: Iterable[Task]) -> list[Task]:
    """Each task once: experiments share first frames and the full method."""
    return list({task.name: task for task in tasks}.values())


def sweep(
    tasks: Sequence[Task],
    executor: TaskQueue,
    *,
    folder: Path,
    device: BackendName = "auto",
    gpus: int = 0,
    listener: Listener | None = None,
) -> Outcome:
    """Does every task that is not done, each in its own process, as soon as those that it needs are done.

    Args:
        tasks: with distinct names, in an order in which each follows the tasks that it needs.
        executor: runs them.
        folder: what tasks print goes to ``logs/NAME.txt`` in it; on other machines it must lie at the same place.
        device: what computes.
        gpus: how many GPUs a task uses, 0 or 1.
        listener: called twice a second.

    Raises:
        KeyboardInterrupt: the executor's ``with`` block ends running tasks; their stored frames are kept for resuming.
    """
    skipped = {task.name for task in tasks if task.done()}
    begun = {task.name: task for task in tasks if task.name not in skipped}
    left, done, failed = dict(begun), set(skipped), list[str]()
    while True:
        for name in [name for name, task in left.items() if done.issuperset(task.needs)]:
            task = left.pop(name)
            command = command_of(task, device, folder=folder / "tasks")
            log = (folder / "logs" / f"{name}.txt").absolute()
            given = executors.Task(name, command, str(task.stream.absolute()), log, retries=1)
            executor.submit(given, gpus=gpus)
        for ending in executor.wait(POLL_SECONDS):
            if ending.done:
                done.add(ending.name)
            else:
                failed.append(ending.name)
        if listener is not None:
            stored = {name: (_stored(begun[name].stream), begun[name].frames) for name in executor.running}
            listener(Progress(stored, len(done), len(tasks), tuple(failed)))
        if not executor.running and not any(done.issuperset(task.needs) for task in left.values()):
            return Outcome(tuple(failed), tuple(left), tuple(sorted(skipped)))


def _stored(stream: Path) -> int:
    """How many frames a running task has logged."""
    from structgstream.evaluation.run_log import log_path

    try:
        with log_path(stream).open() as file:
            return sum(1 for _ in file)
    except OSError:
        return 0

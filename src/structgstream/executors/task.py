# SPDX-License-Identifier: Apache-2.0
"""Tasks (commands that may be repeated at any time), their results, and the worker slots that run them."""

import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from structgstream.errors import ConfigError

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


def argv_of(command: tuple[str, ...]) -> list[str]:
    """The argument vector on this machine."""
    return [sys.executable if word == PYTHON and not i else word for i, word in enumerate(command)]


_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")


@dataclass(frozen=True)
class WorkerSlot:
    """A worker slot, which runs one task at a time: a number of threads, and the index of its GPU if it has one."""

    threads: int
    gpu: int | None = None

    def environment(self, *, gpus: int = 0) -> Mapping[str, str]:
        """Environment variables of a task that uses ``gpus`` GPUs, 0 or 1."""
        seen = str(self.gpu) if gpus and self.gpu is not None else ""
        return thread_environment(self.threads) | {"CUDA_VISIBLE_DEVICES": seen}


def thread_environment(threads: int) -> dict[str, str]:
    """Environment variables that set the number of threads of libraries."""
    return dict.fromkeys(_THREADS, str(threads))


def allocate_slots(
    *, workers: int | None, cores: int, gpus: int = 0, threads: int | None = None
) -> tuple[WorkerSlot, ...]:
    """Slots for ``workers`` concurrent tasks, which use GPUs in turn.

    Args:
        workers: number of slots; None for one per GPU, or one per core without GPUs.
        cores: number of cores that may be used; each slot gets its share, at least one.
        threads: threads of each slot; None for its share of the cores.

    Raises:
        ConfigError: there is less than one worker or thread.
    """
    for name, value in (("workers", workers), ("threads", threads)):
        if value is not None and value < 1:
            raise ConfigError(f"The number of {name} must be 1 or more, got {value}.")
    count = workers or gpus or cores
    share = max(1, cores // count) if threads is None else threads
    return tuple(WorkerSlot(share, number % gpus if gpus else None) for number in range(count))

# SPDX-License-Identifier: Apache-2.0
"""Worker slots of one machine: shares of its cores, and its GPUs."""

from collections.abc import Mapping
from dataclasses import dataclass

from structgstream.errors import ConfigError

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
        gpus: number of GPUs.
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

# SPDX-License-Identifier: Apache-2.0
"""Where tasks of one machine run: shares of its cores, and its GPUs."""

from collections.abc import Mapping
from dataclasses import dataclass

from structgstream.errors import ConfigError

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")


@dataclass(frozen=True)
class Place:
    """Room for one task: a number of threads, and which GPU where there is one."""

    threads: int
    gpu: int | None = None

    def environment(self, *, gpus: int = 0) -> Mapping[str, str]:
        """What a task that uses ``gpus`` GPUs, 0 or 1, sees of the machine."""
        seen = str(self.gpu) if gpus and self.gpu is not None else ""
        return thread_environment(self.threads) | {"CUDA_VISIBLE_DEVICES": seen}


def thread_environment(threads: int) -> dict[str, str]:
    """The variables that make libraries compute with so many threads."""
    return dict.fromkeys(_THREADS, str(threads))


def shared_out(*, workers: int | None, cores: int, gpus: int = 0, threads: int | None = None) -> tuple[Place, ...]:
    """Places for ``workers`` tasks at a time: one for each GPU, which take turns; without GPUs one for each core.

    Args:
        workers: None for one a GPU, or one a core.
        cores: that may be used; each place gets its share, one at least.
        gpus: number of GPUs.
        threads: of each place; None for its share of the cores.

    Raises:
        ConfigError: less than one worker, or thread.
    """
    for name, value in (("workers", workers), ("threads", threads)):
        if value is not None and value < 1:
            raise ConfigError(f"The number of {name} must be 1 or more, got {value}.")
    count = workers or gpus or cores
    share = max(1, cores // count) if threads is None else threads
    return tuple(Place(share, number % gpus if gpus else None) for number in range(count))

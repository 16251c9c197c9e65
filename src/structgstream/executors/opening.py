# SPDX-License-Identifier: Apache-2.0
"""Opens an executor by name."""

from dataclasses import dataclass
from typing import Literal

from structgstream.executors.executor import TaskQueue
from structgstream.executors.inline import InlineEngine
from structgstream.executors.local import LocalEngine
from structgstream.executors.task import allocate_slots

ExecutorName = Literal["inline", "local", "ray"]


@dataclass(frozen=True)
class ExecutorOptions:
    """Options of an executor.

    Args:
        name: ``inline``: this process, one task after the other; ``local``: processes of this machine; ``ray``: a Ray
            cluster.
        workers: number of concurrent tasks; None for one per GPU, or one per core. An existing cluster has its own
            number.
        threads: threads of each worker; None for its share of the cores, and 1 on a cluster.
        address: address of the Ray cluster; None starts one on this machine.
    """

    name: ExecutorName = "local"
    workers: int | None = None
    threads: int | None = None
    address: str | None = None


def open_executor(options: ExecutorOptions, *, cores: int, gpus: int = 0) -> TaskQueue:
    """The executor; use it as a context manager.

    Args:
        options: options of the executor.
        cores: number of cores of this machine that may be used.
        gpus: number of GPUs of this machine that may be used.

    Raises:
        ConfigError: there is less than one worker or thread, or the cluster cannot be joined.
        MissingExtraError: a package is missing.
    """
    slots = allocate_slots(workers=options.workers, cores=cores, gpus=gpus, threads=options.threads)
    if options.name == "inline":
        return TaskQueue(InlineEngine())
    if options.name == "local":
        return TaskQueue(LocalEngine(slots))
    from structgstream.executors.ray_cluster import RayEngine, RayOptions

    threads = options.threads or (1 if options.address else slots[0].threads)
    return TaskQueue(RayEngine(RayOptions(options.address, len(slots), threads)))

# SPDX-License-Identifier: Apache-2.0
"""Runs one task in a separate process, to isolate crashes."""

import os
import sys
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from structgstream.errors import StructGStreamError
from structgstream.kernels.backend import Backend, BackendName


class Task(Protocol):
    """A step of an experiment: a value that can be sent to another process."""

    @property
    def name(self) -> str: ...

    @property
    def needs(self) -> tuple[str, ...]:
        """Names of the tasks that it needs."""
        ...

    @property
    def frames(self) -> int:
        """Number of frames that it fits, for the progress display."""
        ...

    @property
    def stream(self) -> Path:
        """The stream's path; the log beside it shows the progress."""
        ...

    def done(self) -> bool:
        """Whether the task is finished."""
        ...

    def run(self, backend: Backend) -> None:
        """Run the missing steps."""
        ...


@dataclass(frozen=True)
class WorkerSlot:
    """Where a task computes: a back-end, a number of threads, and which GPU where there is one."""

    device: BackendName
    threads: int
    gpu: int | None = None


FAILED = 1


def work(task: Task, seat: WorkerSlot, log: Path) -> None:
    """Runs a task; what it prints goes to ``log``. Ends the process with status 1 when the task fails."""
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a") as file:
        os.dup2(file.fileno(), sys.stdout.fileno())
        os.dup2(file.fileno(), sys.stderr.fileno())
    try:
        import torch

        from structgstream.kernels.backend import select_backend

        torch.set_num_threads(seat.threads)
        if seat.gpu is not None:
            torch.cuda.set_device(seat.gpu)
        task.run(select_backend(seat.device))
    except StructGStreamError as error:
        print(f"{task.name}: {error}", file=sys.stderr, flush=True)
        sys.exit(FAILED)
    except KeyboardInterrupt:
        sys.exit(FAILED)
    except Exception:
        traceback.print_exc()
        sys.exit(FAILED)

# SPDX-License-Identifier: Apache-2.0
"""Runs one task of an experiment as a program: ``python -m structgstream_studies.experiments.worker TASK DEVICE``.

TASK is a file in which :func:`command_of` has written the task, which is a value.
"""

import pickle
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

from structgstream.errors import StorageError, StructGStreamError
from structgstream.executors.tasks import PYTHON
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


DONE, FAILED = 0, 1


def command_of(task: Task, device: BackendName, *, folder: Path) -> tuple[str, ...]:
    """The command that runs a task, which is stored in ``folder`` for it.

    Raises:
        StorageError: the folder cannot be written.
    """
    path = (folder / f"{task.name}.task").absolute()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        path.write_bytes(pickle.dumps(task))
    except OSError as error:
        raise StorageError(f"The task {path} cannot be written ({error.strerror}).") from error
    return (PYTHON, "-m", __name__, str(path), device)


def work(task: Task, device: BackendName) -> int:
    """Runs a task here; what goes wrong is printed. Returns the status of its process."""
    try:
        from structgstream.kernels.backend import select_backend

        task.run(select_backend(device))
    except StructGStreamError as error:
        print(f"{task.name}: {error}", file=sys.stderr, flush=True)
        return FAILED
    except Exception:
        traceback.print_exc()
        return FAILED
    return DONE


def main(arguments: Sequence[str]) -> int:
    """Runs the task of a file that :func:`command_of` has written."""
    path, device = arguments
    task: Task = pickle.loads(Path(path).read_bytes())
    return work(task, device)  # type: ignore[arg-type]


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

# SPDX-License-Identifier: Apache-2.0
"""A task that a process of its own can import: it writes numbered frames, and misbehaves as it is reported."""

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from structgstream.evaluation.run_log import append_log, read_log
from structgstream.kernels.backend import Backend
from structgstream_studies.errors import ExperimentError

PATIENCE_SECONDS = 120.0


@dataclass(frozen=True)
class Frames:
    """Appends to a log what is missing of ``frames`` frames, each with the process that made it.

    Args:
        name: of the task.
        folder: where it writes.
        frames: how many.
        needs: tasks before it.
        meets: a task that must be running, or have run, at the same time before this one begins.
        fails_at: before this frame it fails, once.
        waits_at: before this frame it waits for a file called ``go``.
    """

    name: str
    folder: Path
    frames: int = 1
    needs: tuple[str, ...] = ()
    meets: str | None = None
    fails_at: int | None = None
    waits_at: int | None = None

    @property
    def stream(self) -> Path:
        return self.folder / f"{self.name}.sgs"

    def done(self) -> bool:
        return len(read_log(self.stream)) == self.frames

    def run(self, backend: Backend) -> None:
        (self.folder / f"{self.name}.begun").touch()
        if self.meets is not None:
            _wait(self.folder / f"{self.meets}.begun")
        for index in range(len(read_log(self.stream)), self.frames):
            if index == self.fails_at and not self._failed.exists():
                self._failed.touch()
                raise ExperimentError("there was no power.")
            if index == self.waits_at:
                _wait(self.folder / "go")
            append_log(self.stream, {"index": index, "process": os.getpid(), "backend": backend.name})
        print(f"{self.name} says that it is done")

    @property
    def _failed(self) -> Path:
        return self.folder / f"{self.name}.failed"


@dataclass(frozen=True)
class Calls:
    """Calls a function, in this process."""

    call: Callable[[Backend], None]
    name: str = "calls"
    needs: tuple[str, ...] = ()
    frames: int = 1
    stream: Path = Path("calls.sgs")

    def done(self) -> bool:
        return False

    def run(self, backend: Backend) -> None:
        self.call(backend)


def _wait(path: Path) -> None:
    end = time.monotonic() + PATIENCE_SECONDS
    while not path.exists():
        if time.monotonic() > end:
            raise ExperimentError(f"{path.name} never came.")
        time.sleep(0.05)

# SPDX-License-Identifier: Apache-2.0
"""Parallel runs of commands that only look like the real ones (``tests/support/stand_in.py``)."""

import hashlib
from pathlib import Path

from structgstream.executors.tasks import PYTHON, LocalEngine, TaskQueue, WorkerSlot
from structgstream.parallel.driver import Job, Unit
from tests.support import stand_in

PROGRAM = (PYTHON, "-I", "-S", stand_in.__file__)


def job(folder: Path, *, frames: int = 12, program: tuple[str, ...] = PROGRAM) -> Job:
    """Three groups of four frames."""
    unit = Unit("capture", frames, track=("--groups", "4"), program=program)
    return Job(unit, folder / "out.sgs")


def workers() -> TaskQueue:
    return TaskQueue(LocalEngine([WorkerSlot(1)] * 2))


def sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()

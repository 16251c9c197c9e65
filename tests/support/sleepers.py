# SPDX-License-Identifier: Apache-2.0
"""Commands for executors: quick ones, without this package; whether a process has ended."""

import time
from pathlib import Path

from structgstream.executors.tasks import PYTHON, Task, TaskQueue, TaskResult

PATIENCE_SECONDS = 60.0


def writes(name: str, folder: Path, *, then: str = "true") -> Task:
    """Notes in ``folder/begun`` that it has begun, does ``then``, and makes ``folder/NAME``."""
    script = f'echo {name} >> "$0/begun"; {then} && echo {name} > "$0/{name}"'
    return Task(name, ("sh", "-c", script, str(folder)), str(folder / name), retries=5)


def module(name: str, *arguments: str) -> Task:
    """Runs a module of Python."""
    return Task(name, (PYTHON, "-m", *arguments))


def all_endings(executor: TaskQueue) -> dict[str, TaskResult]:
    """What came of all tasks that can run."""
    endings = {}
    while True:
        endings |= {ending.name: ending for ending in executor.wait(PATIENCE_SECONDS)}
        if not executor.running:
            return endings


def begun(folder: Path) -> list[str]:
    """Names of the tasks in the order in which they began, again each time."""
    return (folder / "begun").read_text().split()


def wait_for(path: Path) -> None:
    """Waits until a file has a whole line."""
    end = time.monotonic() + PATIENCE_SECONDS
    while not (path.exists() and path.read_text().endswith("\n")):
        assert time.monotonic() < end
        time.sleep(0.02)


def is_gone(pid: int) -> bool:
    """Whether a process ends, or is only waited for by its parent."""
    end = time.monotonic() + PATIENCE_SECONDS
    while time.monotonic() < end:
        try:
            state = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
        except (FileNotFoundError, ProcessLookupError):
            return True
        if state == "Z":
            return True
        time.sleep(0.02)
    return False

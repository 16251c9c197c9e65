# SPDX-License-Identifier: Apache-2.0
"""Tasks, which are commands that may be repeated at any time, and their results."""

import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

PYTHON = "{python}"
"""First word of a command that stands for the Python interpreter of the machine that runs it."""
TAIL_BYTES = 4000
"""Number of bytes of a task's output that its result contains."""


@dataclass(frozen=True)
class Task:
    """A command with a result.

    It must be idempotent: restarted after it was killed, or run twice at the same time, it has the same result, which
    it writes atomically.

    Args:
        name: a name that is unique in an executor, usable as a file name.
        command: the argument vector; the first word may be :data:`PYTHON`.
        result: path or URL of its result; frames are not transferred in any other way.
        log: its output is appended to this file; None discards all but the last :data:`TAIL_BYTES`.
        environment: variables to set, in addition to those of its worker slot.
        retries: number of restarts after it was killed. A command that fails by itself is not repeated.
    """

    name: str
    command: tuple[str, ...]
    result: str = ""
    log: Path | None = None
    environment: Mapping[str, str] = field(default_factory=dict)
    retries: int = 5


@dataclass(frozen=True)
class TaskResult:
    """The result of a task.

    Args:
        name: name of the task.
        status: exit status of the command; the negative signal number if a signal ended it.
        seconds: duration of the last attempt.
        attempts: number of attempts.
        peak_bytes: largest resident memory of the command; 0 if unknown.
        output: the end of its output.
    """

    name: str
    status: int
    seconds: float = 0.0
    attempts: int = 1
    peak_bytes: int = 0
    output: str = ""

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

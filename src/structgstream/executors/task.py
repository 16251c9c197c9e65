# SPDX-License-Identifier: Apache-2.0
"""A task is a command that may be run again at any time; its ending says what came of it."""

import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

PYTHON = "{python}"
"""As a command's first word: the interpreter of the process that runs it, which lies elsewhere on other machines."""
TAIL_BYTES = 4000
"""How much of what a task has printed is kept in its ending."""


@dataclass(frozen=True)
class Task:
    """A command with a result.

    It must be idempotent: begun again after it was killed, or run by two at once, it leaves the same result, which
    appears in one step when it is whole.

    Args:
        name: of its own among the tasks of an executor; a file name.
        command: its words; the first may be :data:`PYTHON`.
        result: path or URL of what it makes; frames never travel in any other way.
        log: what it prints is appended to this file; None drops all but the last :data:`TAIL_BYTES`.
        environment: variables to set, beside those of the place where it runs.
        retries: how often it is begun again after it was killed. A command that fails by itself is not repeated.
    """

    name: str
    command: tuple[str, ...]
    result: str = ""
    log: Path | None = None
    environment: Mapping[str, str] = field(default_factory=dict)
    retries: int = 5


@dataclass(frozen=True)
class Ending:
    """What came of a task.

    Args:
        name: of the task.
        status: of the command; negative when a signal ended it, as :class:`subprocess.Popen` counts.
        seconds: of the last attempt.
        attempts: how often it was begun.
        peak_bytes: largest resident memory of the command; 0 where it is not known.
        output: the end of what it printed.
    """

    name: str
    status: int
    seconds: float = 0.0
    attempts: int = 1
    peak_bytes: int = 0
    output: str = ""

    @property
    def done(self) -> bool:
        """Whether the command ended well."""
        return self.status == 0

    @property
    def killed(self) -> bool:
        """Whether a signal ended it."""
        return self.status < 0


def words(command: tuple[str, ...]) -> list[str]:
    """The command as it is run here."""
    return [sys.executable if word == PYTHON and not i else word for i, word in enumerate(command)]

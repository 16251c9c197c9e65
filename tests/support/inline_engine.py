# SPDX-License-Identifier: Apache-2.0
"""An engine that runs tasks in this process, one after the other: patches of a test reach them."""

import io
import os
import runpy
import sys
import time
import traceback
import warnings
from collections.abc import Mapping
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from unittest.mock import patch

from structgstream.executors.tasks import Task, TaskResult, opened_log, tail_of


class InlineEngine:
    """Runs ``{python} -m MODULE ...``."""

    def __init__(self) -> None:
        self._next: Task | None = None

    def check(self, gpus: int) -> None:
        """See ``Engine.check``; a task may use whatever GPU this process sees."""

    def has_room(self, gpus: int) -> bool:
        """See ``Engine.has_room``."""
        return self._next is None

    def start(self, task: Task, *, gpus: int) -> None:
        """See ``Engine.start``; it runs in :meth:`ended`."""
        self._next = task

    def ended(self, seconds: float) -> list[TaskResult]:
        """See ``Engine.ended``; returns when the task has ended, regardless of ``seconds``."""
        task, self._next = self._next, None
        if task is None:
            return []
        begun = time.monotonic()
        status, output = _called(task.command[2], list(task.command[3:]), task.environment, log=task.log)
        return [TaskResult(task.name, status, time.monotonic() - begun, output=output)]

    def stop(self) -> None:
        """See ``Engine.stop``."""
        self._next = None


def _called(module: str, arguments: list[str], environment: Mapping[str, str], *, log: Path | None) -> tuple[int, str]:
    """Runs a module as a program; returns its exit status and the end of its output."""
    with opened_log(log) as file:
        began_at = file.tell()
        with io.TextIOWrapper(file, write_through=True) as text:
            with (
                redirect_stdout(text),
                redirect_stderr(text),
                patch.object(sys, "argv", [module, *arguments]),
                patch.dict(os.environ, environment),
            ):
                status = _status_of(module)
            return status, tail_of(file, began_at)


def _status_of(module: str) -> int:
    try:
        with warnings.catch_warnings():
            # The module may be imported already.
            warnings.filterwarnings("ignore", category=RuntimeWarning, module="runpy")
            runpy.run_module(module, run_name="__main__", alter_sys=True)
    except SystemExit as error:
        if isinstance(error.code, str):
            print(error.code, file=sys.stderr)
        return 0 if error.code is None else error.code if isinstance(error.code, int) else 1
    except Exception:
        traceback.print_exc()
        return 1
    return 0

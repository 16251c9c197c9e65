# SPDX-License-Identifier: Apache-2.0
"""The engine ``inline``: tasks run in this process, one after the other, where a debugger sees them."""

import io
import os
import runpy
import sys
import time
import traceback
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import IO

from structgstream.executors.process import CommandProcess, opened_log, tail_of, waited_for
from structgstream.executors.task import PYTHON, Ending, Task

WAIT_SECONDS = 3600.0
INTERRUPTED = 130
"""The status of a command that Ctrl-C has ended."""


class InlineEngine:
    """Runs ``{python} -m MODULE ...`` in this process; other commands as processes that it waits for."""

    name = "inline"
    repeats = False

    def __init__(self) -> None:
        self._next: Task | None = None

    def check(self, gpus: int) -> None:
        """See ``Engine.check``; a task may use whatever GPU this process sees."""

    def has_room(self, gpus: int) -> bool:
        """See ``Engine.has_room``."""
        return self._next is None

    def start(self, task: Task, *, gpus: int, attempt: int) -> None:
        """See ``Engine.start``; it runs in :meth:`ended`."""
        self._next = task

    def ended(self, seconds: float) -> list[Ending]:
        """See ``Engine.ended``; returns after the task has, however long that takes."""
        task, self._next = self._next, None
        if task is None:
            return []
        if task.command[:2] != (PYTHON, "-m"):
            return [_in_a_process(task)]
        begun = time.monotonic()
        status, said = _called(task.command[2], list(task.command[3:]), task.environment, log=task.log)
        return [Ending(task.name, status, time.monotonic() - begun, output=said)]

    def stop(self) -> None:
        """See ``Engine.stop``."""
        self._next = None


def _in_a_process(task: Task) -> Ending:
    process = CommandProcess(task, environment={})
    try:
        while True:
            waited_for([process], WAIT_SECONDS)
            if (ending := process.ended()) is not None:
                return ending
    except BaseException:
        process.stop()
        raise


def _called(module: str, arguments: list[str], environment: Mapping[str, str], *, log: Path | None) -> tuple[int, str]:
    """Runs a module as the program it is; the status it would end with, and the end of what it has printed.

    Raises:
        KeyboardInterrupt: the user pressed Ctrl-C, also if the program ended because of it.
    """
    with opened_log(log) as file:
        began_at = file.tell()
        with io.TextIOWrapper(file, write_through=True) as text:
            with _printing(text), _as_program(module, arguments, environment):
                status = _status_of(module)
            return status, tail_of(file, began_at)


def _status_of(module: str) -> int:
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", category=RuntimeWarning, module="runpy")  # This process may know it.
            runpy.run_module(module, run_name="__main__", alter_sys=True)
    except SystemExit as ending:
        if ending.code == INTERRUPTED:
            raise KeyboardInterrupt from None
        if isinstance(ending.code, str):
            print(ending.code, file=sys.stderr)
        return 0 if ending.code is None else ending.code if isinstance(ending.code, int) else 1
    except Exception:
        traceback.print_exc()
        return 1
    return 0


@contextmanager
def _as_program(module: str, arguments: list[str], environment: Mapping[str, str]) -> Iterator[None]:
    """The arguments and variables that a process of its own would have, taken back afterwards."""
    given, before = sys.argv, dict(os.environ)
    sys.argv = [module, *arguments]
    os.environ.update(environment)
    try:
        yield
    finally:
        sys.argv = given
        for name in environment:
            if name in before:
                os.environ[name] = before[name]
            else:
                os.environ.pop(name, None)


@contextmanager
def _printing(text: IO[str]) -> Iterator[None]:
    """What the block prints goes to ``text``."""
    with redirect_stdout(text), redirect_stderr(text):
        yield

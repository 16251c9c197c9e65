# SPDX-License-Identifier: Apache-2.0
"""The engine ``inline``: tasks run in this process, one after the other, where a debugger sees them."""

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

from structgstream.executors.process import CommandProcess, waited_for
from structgstream.executors.task import PYTHON, Ending, Task

WAIT_SECONDS = 3600.0


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
        status = _called(task.command[2], list(task.command[3:]), task.environment, log=task.log)
        return [Ending(task.name, status, time.monotonic() - begun)]

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


def _called(module: str, arguments: list[str], environment: Mapping[str, str], *, log: Path | None) -> int:
    """Runs a module as the program it is, and returns the status it would end with.

    Raises:
        KeyboardInterrupt: the user pressed Ctrl-C, also if the program ended because of it.
    """
    with warnings.catch_warnings(), _printing(log), _as_program(module, arguments, environment):
        try:
            warnings.filterwarnings("ignore", category=RuntimeWarning, module="runpy")  # This process may know it.
            runpy.run_module(module, run_name="__main__", alter_sys=True)
        except SystemExit as ending:
            if isinstance(ending.code, str):
                print(ending.code, file=sys.stderr)
            status = 0 if ending.code is None else ending.code if isinstance(ending.code, int) else 1
            if status == 130:
                raise KeyboardInterrupt from None
            return status
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
def _printing(log: Path | None) -> Iterator[None]:
    """What the block prints goes to ``log``."""
    file: IO[str]
    if log is None:
        file = open(os.devnull, "w")  # noqa: SIM115
    else:
        log.parent.mkdir(parents=True, exist_ok=True)
        file = log.open("a")
    with file, redirect_stdout(file), redirect_stderr(file):
        yield

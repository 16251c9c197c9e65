# SPDX-License-Identifier: Apache-2.0
"""A command as a process: begun, waited for, ended with everything that it began."""

import os
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

from structgstream.executors import launch
from structgstream.executors.task import TAIL_BYTES, Ending, Task, words

ENDING_SECONDS = 10.0
"""How long a command may take to end by itself; then it is killed, which loses nothing that is whole."""


class CommandProcess:
    """A task's command, running. It dies with the process that made this.

    Args:
        task: what is run.
        environment: variables of its place; the task's own come before them.
    """

    def __init__(self, task: Task, *, environment: Mapping[str, str]) -> None:
        self.name = task.name
        self._log = opened_log(task.log)
        self._began_at = self._log.tell()
        self._begun = time.monotonic()
        tied = [sys.executable, "-I", "-S", str(Path(launch.__file__)), str(os.getpid())]
        self._process = subprocess.Popen(
            [*tied, *words(task.command)],
            stdin=subprocess.DEVNULL,
            stdout=self._log,
            stderr=self._log,
            env={**os.environ, **environment, **task.environment},
            start_new_session=True,  # Ctrl-C is for this process, which ends the others.
        )
        self.descriptor = os.pidfd_open(self._process.pid)

    @property
    def pid(self) -> int:
        """Of the command."""
        return self._process.pid

    def ended(self, *, attempts: int = 1) -> Ending | None:
        """What came of it; None while it runs. Once it is ended, this may not be asked again."""
        if os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None:
            return None
        self._kill()  # What it began and left behind, while its number is still its own.
        _, status, usage = os.wait4(self.pid, 0)
        self._process.returncode = code = os.waitstatus_to_exitcode(status)
        os.close(self.descriptor)
        seconds = time.monotonic() - self._begun
        with self._log:
            said = tail_of(self._log, self._began_at)
        return Ending(self.name, code, seconds, attempts, usage.ru_maxrss * 1024, said)

    def ask(self) -> None:
        """Asks it to end."""
        with suppress(ProcessLookupError):
            os.killpg(self.pid, signal.SIGTERM)

    def stop(self) -> None:
        """Asks it to end, then kills it and all that it began."""
        self.ask()
        waited_for([self], ENDING_SECONDS)
        self._kill()
        waited_for([self], ENDING_SECONDS)
        self.ended()

    def _kill(self) -> None:
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(self.pid, signal.SIGKILL)


def waited_for(processes: Sequence[CommandProcess], seconds: float) -> bool:
    """Waits until one of them has ended, for at most so long; whether one has."""
    poll = select.poll()
    for process in processes:
        poll.register(process.descriptor, select.POLLIN)
    return bool(poll.poll(round(seconds * 1000)))


def opened_log(log: Path | None) -> BinaryIO:
    """The file that output goes to, at its end; one without a name if there is none."""
    if log is None:
        return tempfile.TemporaryFile()
    log.parent.mkdir(parents=True, exist_ok=True)
    file = log.open("ab+")
    file.seek(0, os.SEEK_END)
    return file


def tail_of(file: BinaryIO, begin: int) -> str:
    """The end of what was written from byte ``begin`` on."""
    end = file.seek(0, os.SEEK_END)
    file.seek(max(begin, end - TAIL_BYTES))
    return file.read().decode(errors="replace")

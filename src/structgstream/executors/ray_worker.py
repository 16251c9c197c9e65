# SPDX-License-Identifier: Apache-2.0
"""Runs the command of a task in a Ray worker and returns its result."""

from collections.abc import Mapping

from structgstream.executors.local import CommandProcess, waited_for
from structgstream.executors.task import Task, TaskResult

POLL_SECONDS = 1.0


class CommandKilled(Exception):
    """A signal ended a command; Ray restarts the task."""


def run_task(task: Task, environment: Mapping[str, str]) -> TaskResult:
    """Runs the command in a process of this machine, which is killed when this process ends.

    Raises:
        CommandKilled: a signal ended it; the message has the signal and the command's output.
    """
    process = CommandProcess(task, environment=environment)
    try:
        # Ray cancels a task by raising an exception between two Python instructions, so a wait must be short.
        while not waited_for([process], POLL_SECONDS):
            pass
    except BaseException:
        process.stop()
        raise
    result = process.ended()
    assert result is not None, "the process has ended"
    if result.killed:
        raise CommandKilled(f"{task.name} was ended by signal {-result.status}. {result.output}")
    return result

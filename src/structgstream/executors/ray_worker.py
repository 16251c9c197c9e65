# SPDX-License-Identifier: Apache-2.0
"""What a Ray worker does with a task: runs its command, and says how it ended."""

from collections.abc import Mapping

from structgstream.executors.process import CommandProcess, waited_for
from structgstream.executors.task import Ending, Task

POLL_SECONDS = 1.0


class CommandKilled(Exception):
    """A signal ended a command: Ray begins the task again."""


def run_task(task: Task, environment: Mapping[str, str]) -> Ending:
    """Runs the command in a process of this machine, which ends with this one.

    Raises:
        CommandKilled: a signal ended it; the message says which, and what it printed.
    """
    process = CommandProcess(task, environment=environment)
    try:
        # Ray cancels a task by an exception between two instructions, so that waiting must come up for air.
        while not waited_for([process], POLL_SECONDS):
            pass
    except BaseException:
        process.stop()
        raise
    ending = process.ended()
    assert ending is not None, "it was waited for"
    if ending.killed:
        raise CommandKilled(f"{task.name} was ended by signal {-ending.status}. {ending.output}")
    return ending

# SPDX-License-Identifier: Apache-2.0
"""A command's first word is an interpreter that lies elsewhere on other machines."""

import pickle
import sys

import pytest

from structgstream.executors.tasks import PYTHON, Task, TaskResult, argv_of


def test_only_the_first_word_is_the_interpreter() -> None:
    assert argv_of((PYTHON, "-m", "this", PYTHON)) == [sys.executable, "-m", "this", PYTHON]
    assert argv_of(("true",)) == ["true"]


@pytest.mark.parametrize(("status", "done", "killed"), [(0, True, False), (1, False, False), (-9, False, True)])
def test_an_ending_says_what_came_of_it(status: int, done: bool, killed: bool) -> None:
    ending = TaskResult("task", status)
    assert (ending.done, ending.killed) == (done, killed)


def test_a_task_can_be_sent() -> None:
    task = Task("task", ("true",), environment={"a": "b"})
    assert pickle.loads(pickle.dumps(task)) == task

# SPDX-License-Identifier: Apache-2.0
"""Tasks in this process: modules as the programs they are, one after the other."""

import os
import sys
from pathlib import Path

import pytest

from structgstream.executors.executor import TaskQueue
from structgstream.executors.inline import InlineEngine
from structgstream.executors.task import PYTHON, Task
from tests.support.sleepers import all_endings, begun, writes

PROGRAM = """
import os, sys
print(os.getpid(), os.environ["COLOUR"], *sys.argv[1:])
{last}
"""


@pytest.fixture
def inline() -> TaskQueue:
    return TaskQueue(InlineEngine())


def run(
    inline: TaskQueue, folder: Path, monkeypatch: pytest.MonkeyPatch, last: str, *arguments: str
) -> tuple[int, str]:
    (folder / "program_here.py").write_text(PROGRAM.format(last=last))
    monkeypatch.syspath_prepend(str(folder))
    log = folder / "logs" / "log.txt"
    task = Task("task", (PYTHON, "-m", "program_here", *arguments), log=log, environment={"COLOUR": "red"})
    inline.submit(task)
    with inline:
        ending = all_endings(inline)["task"]
    assert ending.output == log.read_text()
    return ending.status, log.read_text()


def test_a_module_runs_here_with_its_arguments(
    inline: TaskQueue, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = sys.argv
    assert run(inline, tmp_path, monkeypatch, "", "a", "b") == (0, f"{os.getpid()} red a b\n")
    assert sys.argv is given
    assert "COLOUR" not in os.environ


@pytest.mark.parametrize(
    ("last", "status", "said"),
    [
        ("sys.exit(3)", 3, ""),
        ("sys.exit()", 0, ""),
        ("sys.exit('no power')", 1, "no power"),
        ("raise OSError('paper')", 1, "OSError: paper"),
        ("import no_such_thing", 1, "no_such_thing"),
        ("import runpy; runpy.run_module('no_such_program')", 1, "No module named no_such_program"),
    ],
)
def test_how_a_module_ends_is_its_status(
    inline: TaskQueue, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, last: str, status: int, said: str
) -> None:
    ended, text = run(inline, tmp_path, monkeypatch, last)
    assert ended == status
    assert said in text


@pytest.mark.parametrize("last", ["raise KeyboardInterrupt", "sys.exit(130)"])
def test_ctrl_c_in_a_task_is_ctrl_c_here(
    inline: TaskQueue, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, last: str
) -> None:
    with pytest.raises(KeyboardInterrupt):
        run(inline, tmp_path, monkeypatch, last)


def test_other_commands_are_processes_one_after_the_other(inline: TaskQueue, tmp_path: Path) -> None:
    for name in "abc":
        inline.submit(writes(name, tmp_path, then=f'[ "$(wc -l < "$0/begun")" = {"abc".index(name) + 1} ]'))
    assert all(ending.done for ending in all_endings(inline).values())
    assert begun(tmp_path) == ["a", "b", "c"]

# SPDX-License-Identifier: Apache-2.0
"""A command as a process: its ending, its output, and that nothing of it is left."""

import os
import signal
import tempfile
import time
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from structgstream.executors import tasks as process
from structgstream.executors.tasks import TAIL_BYTES, CommandProcess, Task, TaskResult, tail_of, waited_for
from tests.support.properties import examples
from tests.support.sleepers import PATIENCE_SECONDS, is_gone, wait_for


def begun(*command: str, log: Path | None = None, **variables: str) -> CommandProcess:
    """A running command whose slot has ``variables``."""
    return CommandProcess(Task("task", command, log=log, environment={"OURS": "task"}), environment=variables)


def ending_of(running: CommandProcess) -> TaskResult:
    assert waited_for([running], PATIENCE_SECONDS)
    ending = running.ended()
    assert ending is not None
    return ending


def test_while_it_runs_it_has_no_ending() -> None:
    running = begun("sleep", "60")
    assert running.ended() is None
    assert not waited_for([running], 0.0)
    os.kill(running.pid, signal.SIGKILL)
    ending = ending_of(running)
    assert (ending.name, ending.status, ending.killed) == ("task", -signal.SIGKILL, True)


def test_its_ending_says_what_it_took() -> None:
    begin = time.monotonic()
    ending = ending_of(begun("sh", "-c", "echo said; echo wrong >&2; exit 5"))
    assert (ending.status, ending.output) == (5, "said\nwrong\n")
    assert 0 < ending.seconds <= time.monotonic() - begin
    assert 2**18 < ending.peak_bytes < 2**32, "bytes, not kilobytes"


def test_nothing_comes_in_and_the_tasks_own_variables_come_last() -> None:
    ending = ending_of(begun("sh", "-c", "cat; echo $OURS $THEIRS $HOME", OURS="slot", THEIRS="slot"))
    assert ending.output == f"task slot {os.environ['HOME']}\n"


def test_its_descriptor_is_closed_when_it_has_ended() -> None:
    running = begun("true")
    ending_of(running)
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(running.descriptor)


def test_what_it_leaves_behind_ends_with_it() -> None:
    ending = ending_of(begun("sh", "-c", "sleep 60 & echo $!"))
    assert is_gone(int(ending.output))


def test_asked_it_may_end_by_itself(tmp_path: Path) -> None:
    log = tmp_path / "log"
    running = begun("sh", "-c", "trap 'echo bye; exit 7' TERM; echo ready; while :; do sleep 0.01; done", log=log)
    wait_for(log)
    running.ask()
    ending = ending_of(running)
    assert ending.status == 7
    assert ending.output.endswith("bye\n")


def test_one_that_does_not_listen_is_killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process, "ENDING_SECONDS", 0.2)
    log = tmp_path / "log"
    running = begun("sh", "-c", "trap '' TERM; echo ready; while :; do sleep 0.01; done", log=log)
    wait_for(log)
    running.stop()
    assert is_gone(running.pid)


def test_the_first_of_several_is_waited_for() -> None:
    slow, quick = begun("sleep", "60"), begun("true")
    assert waited_for([slow, quick], PATIENCE_SECONDS)
    assert slow.ended() is None
    assert ending_of(quick).done
    slow.stop()


def test_what_is_no_text_is_no_error() -> None:
    ending = ending_of(begun("printf", "\\377\\376 end"))
    assert ending.output == "�� end"


@examples(100)
@given(st.integers(0, 3 * TAIL_BYTES), st.integers(0, TAIL_BYTES))
def test_a_tail_is_the_end_of_what_was_written_since(length: int, begin: int) -> None:
    begin = min(begin, length)
    data = bytes(97 + i % 26 for i in range(length))
    with tempfile.TemporaryFile() as file:
        file.write(data)
        found = tail_of(file, begin)
    assert found == data[begin:][-TAIL_BYTES:].decode()

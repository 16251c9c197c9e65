# SPDX-License-Identifier: Apache-2.0
"""Processes of this machine: what they see, how they end, and that none is left behind."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from structgstream.errors import ConfigError
from structgstream.executors.tasks import LocalEngine, Task, TaskQueue, WorkerSlot
from tests.support.sleepers import all_endings, begun, is_gone, module, wait_for, writes


def local(count: int = 2, gpu: int | None = None) -> TaskQueue:
    return TaskQueue(LocalEngine([WorkerSlot(1, gpu)] * count))


def test_two_run_at_a_time(tmp_path: Path) -> None:
    """Each waits for the other, so that neither would end alone."""
    with local() as executor:
        for name, other in (("left", "right"), ("right", "left")):
            executor.submit(writes(name, tmp_path, then=f'until grep -q {other} "$0/begun"; do sleep 0.02; done'))
        endings = all_endings(executor)
    assert all(ending.done and ending.peak_bytes > 100_000 for ending in endings.values())


def test_statuses_and_words_come_back(tmp_path: Path) -> None:
    with local() as executor:
        executor.submit(Task("bad", ("sh", "-c", "echo no power >&2; exit 3")))
        executor.submit(Task("absent", ("no-such-command",)))
        executor.submit(module("python", "this"))
        endings = all_endings(executor)
    assert (endings["bad"].status, endings["bad"].output) == (3, "no power\n")
    assert endings["absent"].status == 1
    assert endings["absent"].output == "no-such-command cannot be run (No such file or directory).\n"
    assert "Zen of Python" in endings["python"].output


def test_a_log_holds_every_attempt_and_the_ending_only_the_last(tmp_path: Path) -> None:
    log = tmp_path / "logs" / "killed.txt"
    with local() as executor:
        executor.submit(Task("killed", ("sh", "-c", "echo ouch; kill -9 $$"), log=log, retries=2))
        ending = all_endings(executor)["killed"]
    assert (ending.status, ending.attempts, ending.output) == (-signal.SIGKILL, 3, "ouch\n")
    assert log.read_text() == "ouch\n" * 3


def test_a_place_gives_threads_and_hides_other_gpus(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    words = ("sh", "-c", "echo $OMP_NUM_THREADS/$CUDA_VISIBLE_DEVICES/$OURS")
    with local(1, gpu=5) as executor:
        executor.submit(Task("with", words, environment={"OURS": "1"}), gpus=1)
        executor.submit(Task("without", words))
        endings = all_endings(executor)
    assert endings["with"].output == "1/5/1\n"
    assert endings["without"].output == "1//\n"


@pytest.mark.parametrize(("visible", "second"), [("2, 3", "3"), ("GPU-8932f937,GPU-46123a21,-1", "GPU-46123a21")])
def test_gpus_are_of_those_that_this_process_sees(monkeypatch: pytest.MonkeyPatch, visible: str, second: str) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    assert WorkerSlot(1, gpu=1).environment(gpus=1)["CUDA_VISIBLE_DEVICES"] == second
    assert WorkerSlot(1, gpu=1).environment()["CUDA_VISIBLE_DEVICES"] == ""


def test_a_task_without_a_gpu_leaves_it_to_those_that_need_one(tmp_path: Path) -> None:
    meets = 'until [ "$(wc -l < "$0/begun")" = 2 ]; do sleep 0.02; done'
    with TaskQueue(LocalEngine([WorkerSlot(1, gpu=0), WorkerSlot(1)])) as executor:
        executor.submit(writes("plain", tmp_path, then=meets))
        executor.submit(writes("needs", tmp_path, then=meets), gpus=1)
        assert all(ending.done for ending in all_endings(executor).values())


def test_a_gpu_that_is_not_there_is_reported_at_once() -> None:
    with local() as executor, pytest.raises(ConfigError, match="needs 1 GPUs, and a worker here has 0"):
        executor.submit(module("a", "this"), gpus=1)


def test_closing_ends_what_runs_with_what_it_began(tmp_path: Path) -> None:
    with local() as executor:
        executor.submit(Task("long", ("sh", "-c", 'sleep 60 & echo $! > "$0/child"; wait', str(tmp_path))))
        executor.wait(0.1)
        wait_for(tmp_path / "child")
        assert executor.running == ("long",)
    assert is_gone(int((tmp_path / "child").read_text()))


def test_tasks_end_with_a_driver_that_is_killed(tmp_path: Path) -> None:
    code = f"""
from tests.support.sleepers import writes
from tests.executors.test_local import local
from pathlib import Path
with local() as executor:
    executor.submit(writes("long", Path({str(tmp_path)!r}), then='echo $$ > "$0/child"; exec sleep 60'))
    executor.wait(60)
"""
    path = os.pathsep.join([str(Path(__file__).parents[2]), *filter(None, sys.path)])
    driver = subprocess.Popen([sys.executable, "-c", code], env={**os.environ, "PYTHONPATH": path})
    wait_for(tmp_path / "child")
    driver.kill()
    driver.wait()
    assert is_gone(int((tmp_path / "child").read_text()))
    assert begun(tmp_path) == ["long"]

# SPDX-License-Identifier: Apache-2.0
"""Tasks: their order and where they run; as processes of this machine, how they end, and that none is left behind."""

import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from structgstream.errors import ConfigError
from structgstream.executors import launch, ray_cluster, tasks
from structgstream.executors.tasks import (
    TAIL_BYTES,
    CommandProcess,
    ExecutorName,
    ExecutorOptions,
    LocalEngine,
    Task,
    TaskQueue,
    TaskResult,
    WorkerSlot,
    open_executor,
    tail_of,
    waited_for,
)
from tests.support.properties import examples
from tests.support.sleepers import PATIENCE_SECONDS, all_endings, begun, is_gone, module, wait_for, writes


class Scripted:
    """An engine of ``room`` slots; tasks end in the order of a seed, with the statuses that are given for them."""

    def __init__(self, room: int, statuses: dict[str, list[int]] | None = None, *, seed: int = 0) -> None:
        self._room, self._random, self._statuses = room, random.Random(seed), statuses or {}
        self._running: list[tuple[str, int]] = []
        self.begun: list[str] = []
        self.stopped = False
        self.gpus_left = 1

    def check(self, gpus: int) -> None:
        if gpus > 1:
            raise ConfigError("one GPU")

    def has_room(self, gpus: int) -> bool:
        return len(self._running) < self._room and gpus <= self.gpus_left

    def start(self, task: Task, *, gpus: int) -> None:
        assert self.has_room(gpus)
        self.gpus_left -= gpus
        self._running.append((task.name, gpus))
        self.begun.append(task.name)

    def ended(self, seconds: float) -> list[TaskResult]:
        name, gpus = self._running.pop(self._random.randrange(len(self._running)))
        self.gpus_left += gpus
        statuses = self._statuses.get(name, [])
        return [TaskResult(name, statuses.pop(0) if statuses else 0)]

    def stop(self) -> None:
        self.stopped = True


def task(name: str, retries: int = 2) -> Task:
    return Task(name, ("true",), retries=retries)


def run(queue: TaskQueue) -> list[TaskResult]:
    endings: list[TaskResult] = []
    while True:
        endings += queue.wait(1.0)
        if not queue.running:
            return endings


def test_tasks_begin_in_the_order_of_submission() -> None:
    engine = Scripted(2)
    queue = TaskQueue(engine)
    for name in "abcdef":
        queue.submit(task(name))
    run(queue)
    assert engine.begun == list("abcdef")


def test_a_killed_task_is_begun_again_before_others_so_often_and_no_more() -> None:
    engine = Scripted(1, {"a": [-9, -9, 0], "b": [-9, -9, -9, 0]})
    queue = TaskQueue(engine)
    for name in "abc":
        queue.submit(task(name, retries=2))
    endings = {ending.name: ending for ending in run(queue)}
    assert engine.begun == list("aaabbbc")
    assert (endings["a"].done, endings["a"].attempts) == (True, 3)
    assert (endings["b"].killed, endings["b"].attempts) == (True, 3)


def test_a_task_that_fails_is_not_repeated() -> None:
    queue = TaskQueue(Scripted(1, {"a": [3]}))
    for name in "ad":
        queue.submit(task(name))
    assert queue.waiting == ("a", "d")
    assert [(ending.name, ending.status) for ending in run(queue)] == [("a", 3), ("d", 0)]
    assert not queue.waiting


def test_a_task_that_waits_for_a_gpu_lets_others_pass() -> None:
    engine = Scripted(2)
    queue = TaskQueue(engine)
    for name, gpus in (("a", 1), ("b", 1), ("c", 0)):
        queue.submit(task(name), gpus=gpus)
    queue.wait(1.0)
    assert engine.begun[:2] == ["a", "c"]
    assert {ending.name for ending in run(queue)} | {"a", "c"} >= {"b"}


def test_two_of_one_name_and_impossible_ones_are_refused() -> None:
    queue = TaskQueue(Scripted(1))
    queue.submit(task("a"))
    with pytest.raises(ConfigError, match="two tasks with the name 'a'"):
        queue.submit(task("a"))
    with pytest.raises(ConfigError, match="one GPU"):
        queue.submit(task("b"), gpus=2)


def test_its_block_ends_the_engine_also_after_an_error() -> None:
    def interrupted(queue: TaskQueue) -> None:
        with queue:
            queue.submit(task("a"))
            raise KeyboardInterrupt

    engine = Scripted(1)
    with pytest.raises(KeyboardInterrupt):
        interrupted(TaskQueue(engine))
    assert engine.stopped


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What engines are begun with."""
    given: list[Any] = []

    class Engine:
        def __init__(self, *arguments: Any) -> None:
            given.extend(arguments)

        def stop(self) -> None:
            pass

    monkeypatch.setattr(tasks, "LocalEngine", Engine)
    monkeypatch.setattr(ray_cluster, "RayEngine", Engine)
    return given


def open_and_close(options: ExecutorOptions, *, cores: int, gpus: int = 0) -> None:
    with open_executor(options, cores=cores, gpus=gpus):
        pass


def test_local_has_a_place_for_each_core_or_gpu_or_as_asked(opened: list[Any]) -> None:
    for options, gpus in (
        (ExecutorOptions(), 0),
        (ExecutorOptions(), 2),
        (ExecutorOptions(workers=2), 0),
        (ExecutorOptions(workers=3, threads=2), 2),
    ):
        open_and_close(options, cores=4, gpus=gpus)
    cores, gpus, two, three = opened
    assert cores == (WorkerSlot(1),) * 4
    assert gpus == (WorkerSlot(2, 0), WorkerSlot(2, 1))
    assert two == (WorkerSlot(2),) * 2
    assert three == (WorkerSlot(2, 0), WorkerSlot(2, 1), WorkerSlot(2, 0))


def test_a_cluster_of_this_machine_has_its_share_and_one_that_is_joined_one_thread(opened: list[Any]) -> None:
    open_and_close(ExecutorOptions("ray", workers=2), cores=8)
    open_and_close(ExecutorOptions("ray", workers=2, address="head:1"), cores=8)
    open_and_close(ExecutorOptions("ray", workers=2, threads=3, address="head:1"), cores=8)
    assert opened == [None, 2, 4, "head:1", 2, 1, "head:1", 2, 3]


@pytest.mark.parametrize("name", ["local", "ray"])
@pytest.mark.parametrize(
    ("workers", "threads", "said"),
    [(0, None, "workers must be 1 or more, got 0"), (1, -2, "threads must be 1 or more, got -2")],
)
def test_less_than_one_is_refused_whatever_runs(
    opened: list[Any], name: ExecutorName, workers: int, threads: int | None, said: str
) -> None:
    with pytest.raises(ConfigError, match=f"The number of {said}"):
        open_and_close(ExecutorOptions(name, workers, threads), cores=4)
    assert not opened


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
from tests.executors.test_tasks import local
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


def running_of(*command: str, log: Path | None = None, **variables: str) -> CommandProcess:
    """A running command whose slot has ``variables``."""
    return CommandProcess(Task("task", command, log=log, environment={"OURS": "task"}), environment=variables)


def ending_of(running: CommandProcess) -> TaskResult:
    assert waited_for([running], PATIENCE_SECONDS)
    ending = running.ended()
    assert ending is not None
    return ending


def test_while_it_runs_it_has_no_ending() -> None:
    running = running_of("sleep", "60")
    assert running.ended() is None
    assert not waited_for([running], 0.0)
    os.kill(running.pid, signal.SIGKILL)
    ending = ending_of(running)
    assert (ending.name, ending.status, ending.killed) == ("task", -signal.SIGKILL, True)


def test_its_ending_says_what_it_took() -> None:
    begin = time.monotonic()
    ending = ending_of(running_of("sh", "-c", "echo said; echo wrong >&2; exit 5"))
    assert (ending.status, ending.output) == (5, "said\nwrong\n")
    assert 0 < ending.seconds <= time.monotonic() - begin
    assert 2**18 < ending.peak_bytes < 2**32, "bytes, not kilobytes"


def test_nothing_comes_in_and_the_tasks_own_variables_come_last() -> None:
    ending = ending_of(running_of("sh", "-c", "cat; echo $OURS $THEIRS $HOME", OURS="slot", THEIRS="slot"))
    assert ending.output == f"task slot {os.environ['HOME']}\n"


def test_its_descriptor_is_closed_when_it_has_ended() -> None:
    running = running_of("true")
    ending_of(running)
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(running.descriptor)


def test_what_it_leaves_behind_ends_with_it() -> None:
    ending = ending_of(running_of("sh", "-c", "sleep 60 & echo $!"))
    assert is_gone(int(ending.output))


def test_asked_it_may_end_by_itself(tmp_path: Path) -> None:
    log = tmp_path / "log"
    running = running_of("sh", "-c", "trap 'echo bye; exit 7' TERM; echo ready; while :; do sleep 0.01; done", log=log)
    wait_for(log)
    running.ask()
    ending = ending_of(running)
    assert ending.status == 7
    assert ending.output.endswith("bye\n")


def test_one_that_does_not_listen_is_killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tasks, "ENDING_SECONDS", 0.2)
    log = tmp_path / "log"
    running = running_of("sh", "-c", "trap '' TERM; echo ready; while :; do sleep 0.01; done", log=log)
    wait_for(log)
    running.stop()
    assert is_gone(running.pid)


def test_the_first_of_several_is_waited_for() -> None:
    slow, quick = running_of("sleep", "60"), running_of("true")
    assert waited_for([slow, quick], PATIENCE_SECONDS)
    assert slow.ended() is None
    assert ending_of(quick).done
    slow.stop()


def test_what_is_no_text_is_no_error() -> None:
    ending = ending_of(running_of("printf", "\\377\\376 end"))
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


LAUNCH = [sys.executable, "-I", "-S", launch.__file__]
LINUX = pytest.mark.skipif(sys.platform != "linux", reason="only Linux ends a process with its parent")


def launched(*command: str, parent: int) -> subprocess.Popen[str]:
    words = [*LAUNCH, str(parent), *command]
    return subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def test_it_becomes_the_command_with_its_words_and_status() -> None:
    process = launched("sh", "-c", 'echo "$$ $0 and $1"; exit 3', "two words", "*", parent=os.getpid())
    assert process.communicate() == (f"{process.pid} two words and *\n", ""), "the same process"
    assert process.returncode == 3


@LINUX
def test_a_parent_that_has_ended_before_begins_nothing(tmp_path: Path) -> None:
    process = launched("touch", str(tmp_path / "begun"), parent=1)
    assert process.communicate() == ("", "")
    assert process.returncode == 0
    assert not (tmp_path / "begun").exists()

# SPDX-License-Identifier: Apache-2.0
"""The queue: the order of tasks, which are started again, and what remains; on an engine that runs nothing."""

import random

import pytest

from structgstream.errors import ConfigError
from structgstream.executors.tasks import Task, TaskQueue, TaskResult


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

# SPDX-License-Identifier: Apache-2.0
"""What a Ray worker does with a task: no cluster is needed for that."""

import pickle
from pathlib import Path
from typing import Any

import pytest

from structgstream.executors import ray_cluster as ray_worker
from structgstream.executors.ray_cluster import CommandKilled, run_task
from structgstream.executors.tasks import CommandProcess, Task


def test_an_ending_comes_back_also_of_one_that_fails() -> None:
    done = run_task(Task("a", ("sh", "-c", "echo $WHERE")), {"WHERE": "here"})
    assert (done.name, done.status, done.attempts, done.output) == ("a", 0, 1, "here\n")
    failed = run_task(Task("b", ("sh", "-c", "echo no power; exit 3")), {})
    assert (failed.done, failed.killed, failed.status, failed.output) == (False, False, 3, "no power\n")


def test_one_that_was_killed_is_an_exception_that_says_what_it_printed() -> None:
    with pytest.raises(CommandKilled, match=r"^a was ended by signal 9\. half\n$") as found:
        run_task(Task("a", ("sh", "-c", "echo half; kill -9 $$")), {})
    assert str(pickle.loads(pickle.dumps(found.value))) == str(found.value), "Ray carries it to the driver"


def test_it_waits_as_often_as_it_must(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(ray_worker, "POLL_SECONDS", 0.01)
    monkeypatch.setattr(ray_worker, "waited_for", counted := Counted(tmp_path, then=3))
    command = ("sh", "-c", 'until [ -e "$0/go" ]; do sleep 0.01; done', str(tmp_path))
    assert run_task(Task("a", command), {}).done
    assert counted.times >= 3


class Counted:
    """Waiting, which lets the command go on after some times."""

    def __init__(self, folder: Path, *, then: int) -> None:
        self._folder, self._then = folder, then
        self._real = ray_worker.waited_for
        self.times = 0

    def __call__(self, *arguments: Any) -> bool:
        self.times += 1
        if self.times == self._then:
            (self._folder / "go").touch()
        return self._real(*arguments)


@pytest.mark.parametrize("cancelled", [KeyboardInterrupt, SystemExit, RuntimeError])
def test_cancelled_it_leaves_no_command(monkeypatch: pytest.MonkeyPatch, cancelled: type[BaseException]) -> None:
    seen: list[CommandProcess] = []

    def cancel(processes: list[CommandProcess], seconds: float) -> bool:
        seen.extend(processes)
        raise cancelled

    monkeypatch.setattr(ray_worker, "waited_for", cancel)
    with pytest.raises(cancelled):
        run_task(Task("a", ("sleep", "60")), {})
    assert not Path(f"/proc/{seen[0].pid}").exists()

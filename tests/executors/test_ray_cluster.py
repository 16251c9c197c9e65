# SPDX-License-Identifier: Apache-2.0
"""Tasks on Ray: what is asked of it, by a stand-in; and, where Ray is installed, what comes of it."""

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from structgstream.errors import ConfigError, MissingExtraError
from structgstream.executors import ray_cluster
from structgstream.executors.ray_cluster import RayEngine, run_task
from structgstream.executors.tasks import CommandProcess, Task, TaskQueue
from tests.support.sleepers import all_endings


class FakeRay:
    """Has the functions that are called; tasks end in the order in which they were begun, when asked."""

    __version__ = "2.60.0"

    class exceptions:
        class RayError(Exception):
            pass

        class RayTaskError(RayError):
            pass

    def __init__(self) -> None:
        self.begun: list[dict[str, Any]] = []
        self.given: dict[str, Any] = {}
        self.cancelled: list[int] = []
        self.most = 0
        self.fails: dict[str, Exception] = {}
        self._in_flight: set[int] = set()

    def init(self, **given: Any) -> None:
        self.given = given

    def shutdown(self) -> None:
        self.given = {}

    def cluster_resources(self) -> dict[str, float]:
        return {"CPU": 4.0}

    def remote(self, function: Any) -> Any:
        assert function is run_task

        def options(**asked: Any) -> Any:
            def remote(task: Task, environment: dict[str, str]) -> int:
                self.begun.append({**asked, "task": task, "environment": environment})
                self._in_flight.add(len(self.begun) - 1)
                self.most = max(self.most, len(self._in_flight))
                return len(self.begun) - 1

            return SimpleNamespace(remote=remote)

        return SimpleNamespace(options=options)

    def wait(self, references: list[int], *, num_returns: int, timeout: float) -> tuple[list[int], list[int]]:
        return references[:num_returns], references[num_returns:]

    def get(self, reference: int) -> Any:
        self._in_flight.discard(reference)
        task = self.begun[reference]["task"]
        if task.name in self.fails:
            raise self.fails[task.name]
        return run_task(task, {})

    def cancel(self, reference: int) -> None:
        self.cancelled.append(reference)


@pytest.fixture
def ray(monkeypatch: pytest.MonkeyPatch) -> FakeRay:
    fake = FakeRay()
    for name in [name for name in os.environ if name.startswith("RAY_")]:
        monkeypatch.delenv(name)
    monkeypatch.setattr(os, "environ", dict(os.environ))
    monkeypatch.setitem(sys.modules, "ray", fake)  # type: ignore[arg-type]
    return fake


def test_a_cluster_that_is_begun_here_has_a_token_and_nothing_that_tells_or_listens(ray: FakeRay) -> None:
    begun = RayEngine(None, workers=2, cores=3)
    assert os.environ["RAY_AUTH_MODE"] == "token"
    assert len(os.environ["RAY_AUTH_TOKEN"]) == 64
    assert os.environ["RAY_USAGE_STATS_ENABLED"] == "0"
    assert (ray.given["num_cpus"], ray.given["include_dashboard"]) == (6, False)
    folder = Path(ray.given["_temp_dir"])
    assert folder.is_dir()
    begun.stop()
    assert not folder.exists()


def test_few_tasks_are_in_flight_and_ray_does_not_repeat_them(ray: FakeRay) -> None:
    with TaskQueue(RayEngine(None, workers=2, cores=2)) as executor:
        for i in range(20):
            executor.submit(Task(f"{i}", ("true",), log=Path("log.txt")))
        endings = all_endings(executor)
    assert len(endings) == 20
    assert all(ending.done for ending in endings.values())
    assert ray.most == 4
    asked = ray.begun[0]
    assert (asked["max_retries"], asked["num_cpus"]) == (0, 2)
    assert asked["environment"]["OMP_NUM_THREADS"] == "2"
    assert asked["task"].log is None
    assert not Path("log.txt").exists()


def test_what_ray_gives_up_counts_as_killed_and_says_why(ray: FakeRay) -> None:
    ray.fails = {
        "lost": ray.exceptions.RayError("the machine is gone"),
        "bad": ray.exceptions.RayTaskError("no module"),
    }
    with TaskQueue(RayEngine()) as executor:
        for name in ray.fails:
            executor.submit(Task(name, ("true",), retries=2))
        lost, bad = map(all_endings(executor).get, ("lost", "bad"))
    assert (lost.killed, lost.attempts, lost.output) == (True, 3, "the machine is gone")
    assert (bad.killed, bad.done, bad.attempts, bad.output) == (False, False, 1, "no module")


@pytest.mark.parametrize("cancelled", [KeyboardInterrupt, SystemExit, RuntimeError])
def test_a_cancelled_worker_leaves_no_command(monkeypatch: pytest.MonkeyPatch, cancelled: type[BaseException]) -> None:
    seen: list[CommandProcess] = []

    def cancel(processes: list[CommandProcess], seconds: float) -> bool:
        seen.extend(processes)
        raise cancelled

    monkeypatch.setattr(ray_cluster, "waited_for", cancel)
    with pytest.raises(cancelled):
        run_task(Task("a", ("sleep", "60")), {})
    assert not Path(f"/proc/{seen[0].pid}").exists()


def test_closing_cancels_what_runs(ray: FakeRay) -> None:
    executor = TaskQueue(RayEngine())
    executor.submit(Task("a", ("true",)))
    executor._begin()
    executor.close()
    assert ray.cancelled == [0]
    assert not ray.given


def test_a_cluster_without_a_token_is_not_joined(ray: FakeRay, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    with pytest.raises(ConfigError, match="no token for the Ray cluster"):
        RayEngine("head:6379")
    for mode in ("disabled", "off", ""):
        os.environ["RAY_AUTH_MODE"] = mode
        with pytest.raises(ConfigError, match=f"RAY_AUTH_MODE is '{mode}'"):
            RayEngine("head:6379")
    os.environ |= {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN_PATH": str(tmp_path)}
    joined = RayEngine("head:6379")
    assert ray.given["address"] == "head:6379"
    joined.stop()


def test_a_cluster_that_refuses_is_reported(ray: FakeRay, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(**given: Any) -> None:
        raise ConnectionError("Failed to connect")

    os.environ["RAY_AUTH_TOKEN"] = "word"
    monkeypatch.setattr(ray, "init", refused)
    with pytest.raises(ConfigError, match=r"head:6379 cannot be joined \(Failed to connect\)"):
        RayEngine("head:6379")
    with pytest.raises(ConfigError, match=r"cannot be started here \(Failed to connect\)"):
        RayEngine()


def test_an_old_ray_or_none_is_reported(ray: FakeRay, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray, "__version__", "2.51.2", raising=False)
    with pytest.raises(ConfigError, match="Ray 2.51.2 has no token authentication; 2.52 is the first"):
        RayEngine()
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingExtraError, match="cluster"):
        RayEngine()


REAL = """
import json, sys
from structgstream.executors.ray_cluster import RayEngine
from structgstream.executors.tasks import PYTHON, Task, TaskQueue
from tests.support.sleepers import all_endings
folder = sys.argv[1]
with TaskQueue(RayEngine(None, workers=2)) as executor:
    executor.submit(Task("first", ("sh", "-c", "echo $OMP_NUM_THREADS")))
    executor.submit(Task("python", (PYTHON, "-m", "this")))
    executor.submit(Task("bad", ("sh", "-c", "echo no power; exit 3")))
    executor.submit(Task("once", ("sh", "-c", 'test -e "$0/once" || { touch "$0/once"; kill -9 $$; }', folder)))
    executor.submit(Task("always", ("sh", "-c", 'echo x >> "$0/always"; kill -9 $$', folder), retries=2))
    endings = all_endings(executor)
print(json.dumps({name: [ending.status, ending.output[:40]] for name, ending in endings.items()}))
"""


@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="ray, of the extra cluster, is not installed")
def test_tasks_on_a_real_cluster_of_this_machine(tmp_path: Path) -> None:
    path = os.pathsep.join([str(Path(__file__).parents[2]), *filter(None, sys.path)])
    environment = {**os.environ, "PYTHONPATH": path}
    command = [sys.executable, "-c", REAL, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    endings = json.loads(done.stdout.splitlines()[-1])
    assert endings["first"] == [0, "1\n"]
    assert endings["python"][0] == endings["once"][0] == 0
    assert endings["bad"] == [3, "no power\n"]
    assert endings["always"][0] == -9
    assert (tmp_path / "always").read_text() == "x\n" * 3

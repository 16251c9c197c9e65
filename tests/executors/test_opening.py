# SPDX-License-Identifier: Apache-2.0
"""The executor that a caller names, with as many slots as it asks for."""

from typing import Any

import pytest

from structgstream.errors import ConfigError
from structgstream.executors import ray_cluster
from structgstream.executors import tasks as opening
from structgstream.executors.tasks import ExecutorName, ExecutorOptions, WorkerSlot, open_executor


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What engines are begun with."""
    given: list[Any] = []

    class Engine:
        def __init__(self, *arguments: Any) -> None:
            given.extend(arguments)

        def stop(self) -> None:
            pass

    monkeypatch.setattr(opening, "LocalEngine", Engine)
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

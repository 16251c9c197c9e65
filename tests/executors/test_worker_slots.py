# SPDX-License-Identifier: Apache-2.0
"""Cores are shared out, GPUs take turns."""

import pytest

from structgstream.errors import ConfigError
from structgstream.executors.tasks import WorkerSlot, allocate_slots


@pytest.mark.parametrize(("workers", "threads"), [(None, [1] * 8), (3, [2] * 3), (1, [8]), (12, [1] * 12)])
def test_cores_are_shared_out(workers: int | None, threads: list[int]) -> None:
    assert allocate_slots(workers=workers, cores=8) == tuple(WorkerSlot(count) for count in threads)


def test_workers_take_turns_on_the_gpus() -> None:
    assert [slot.gpu for slot in allocate_slots(workers=None, cores=8, gpus=2)] == [0, 1]
    assert [slot.gpu for slot in allocate_slots(workers=3, cores=8, gpus=2)] == [0, 1, 0]


def test_threads_may_be_given() -> None:
    assert allocate_slots(workers=2, cores=8, threads=1) == (WorkerSlot(1), WorkerSlot(1))


@pytest.mark.parametrize("wrong", [{"workers": 0}, {"workers": 1, "threads": 0}])
def test_less_than_one_is_refused(wrong: dict[str, int]) -> None:
    with pytest.raises(ConfigError, match="1 or more, got 0"):
        allocate_slots(**{"workers": None, "cores": 8, **wrong})


def test_a_task_sees_its_threads_and_its_gpu_alone() -> None:
    seen = WorkerSlot(3, gpu=1).environment(gpus=1)
    assert seen["OMP_NUM_THREADS"] == seen["OPENCV_FOR_THREADS_NUM"] == "3"
    assert seen["CUDA_VISIBLE_DEVICES"] == "1"
    assert WorkerSlot(3, gpu=1).environment()["CUDA_VISIBLE_DEVICES"] == ""

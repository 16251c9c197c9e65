# SPDX-License-Identifier: Apache-2.0
"""What every test shares: one thread unless it says otherwise, torch's generator restored, the GPU marker.

Note [Threads of tests]
~~~~~~~~~~~~~~~~~~~~~~~
Pictures here are so small that a second thread costs more than it does, and where several processes test at a time
threads that wait for each other in a loop take the processors from those that work. So there is one thread, threads
that a test asks for sleep while they wait, and processes that a test starts do the same. OpenMP reads this when it is
loaded, which is why nothing above the functions imports torch.

Note [Syncing in tests]
~~~~~~~~~~~~~~~~~~~~~~~
No test takes the power away, and a killed process loses nothing that it has handed to the system. Waiting for the disk
was a third of the time of tests of files, so ``os.fsync`` only checks its descriptor here; tests of what is synced, and
when, put their own function in its place.

Note [Collecting in two processes]
~~~~~~~~~~~~~~~~~~~~~~~~~~~~~~~~~~
pytest rewrites the assertions of a file that it loads for the first time and keeps the result, which takes two thirds
of the time of collecting. Processes that go through the same files in the same order do it all at the same moment, each
for itself. So every second process takes each folder from its end, and reads there what the other has written; all of
them run the tests in the usual order.
"""

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.properties import use_for_all
from tests.support.shared_folder import open_shared_folder

SHARED = pytest.StashKey[Path | None]()
WORKER = os.environ.get("PYTEST_XDIST_WORKER")
FROM_THE_END = WORKER is not None and int(WORKER.removeprefix("gw")) % 2 == 1


class _FromTheEnd(pytest.Dir):
    def collect(self) -> Iterator[pytest.Item | pytest.Collector]:
        return reversed(list(super().collect()))


def pytest_configure(config: pytest.Config) -> None:
    os.fsync = os.fstat  # type: ignore[assignment]  # Note [Syncing in tests]
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    use_for_all()
    config.stash[SHARED] = open_shared_folder()


def pytest_unconfigure(config: pytest.Config) -> None:
    if folder := config.stash.get(SHARED, None):
        shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(autouse=True)
def quiet_randomness() -> Iterator[None]:
    import torch

    state, threads = torch.get_rng_state(), torch.get_num_threads()
    # torch.manual_seed formats the stack for GPUs that nothing has used yet: a millisecond a test.
    torch.default_generator.manual_seed(0)
    if torch.cuda.is_initialized():
        torch.cuda.manual_seed_all(0)
    yield
    torch.set_rng_state(state)
    torch.set_num_threads(threads)


def pytest_collect_directory(path: Path, parent: pytest.Collector) -> pytest.Dir | None:
    # Note [Collecting in two processes]
    return _FromTheEnd.from_parent(parent, path=path) if FROM_THE_END else None


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    import torch

    if WORKER is not None:  # In the same order in all, whatever folders were named.
        items.sort(key=lambda item: item.path.parts)
    if torch.cuda.is_available() or os.environ.get("STRUCTGSTREAM_REQUIRE_CUDA"):
        return
    skip = pytest.mark.skip(reason="no NVIDIA GPU on this machine")
    for item in items:
        if item.get_closest_marker("needs_cuda"):
            item.add_marker(skip)

# SPDX-License-Identifier: Apache-2.0
"""What a task's process does: computes where it was told to, and says in its log why it failed."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import torch

from fake_tasks import Calls
from structgstream.errors import ConfigError
from structgstream.kernels.backend import Backend
from structgstream_studies.experiments.worker import WorkerSlot, work

SEAT = WorkerSlot("reference", 3)


@contextmanager
def own_streams(folder: Path) -> Iterator[None]:
    """Files in the place of this process's output, which a task's process sends elsewhere for good."""
    old = sys.stdout, sys.stderr
    with (folder / "out").open("w", buffering=1) as out, (folder / "error").open("w", buffering=1) as error:
        sys.stdout, sys.stderr = out, error
        try:
            yield
        finally:
            sys.stdout, sys.stderr = old


def test_a_task_gets_the_back_end_and_the_threads_of_its_seat(tmp_path: Path) -> None:
    seen: list[Any] = []
    with own_streams(tmp_path):
        work(Calls(lambda backend: seen.extend([backend.name, torch.get_num_threads()])), SEAT, tmp_path / "log.txt")
    assert seen == ["reference", 3]


def test_what_a_task_prints_goes_to_its_log_after_what_is_there(tmp_path: Path) -> None:
    log = tmp_path / "new" / "log.txt"
    for word in ("hello", "again"):
        with own_streams(tmp_path):
            work(Calls(lambda backend, word=word: print(word)), SEAT, log)
        assert (tmp_path / "out").read_text() == (tmp_path / "error").read_text() == ""
    assert log.read_text() == "hello\nagain\n"


def failing(error: BaseException) -> Calls:
    def call(backend: Backend) -> None:
        raise error

    return Calls(call)


@pytest.mark.parametrize(
    ("error", "said", "traceback"),
    [
        (ConfigError("The rate must be positive, got -1."), "calls: The rate must be positive, got -1.\n", False),
        (RuntimeError("out of paper"), "RuntimeError: out of paper\n", True),
        (KeyboardInterrupt(), "", False),
    ],
    ids=["ours", "another", "ctrl-c"],
)
def test_a_task_that_fails_ends_its_process_with_status_1(
    tmp_path: Path, error: BaseException, said: str, traceback: bool
) -> None:
    with own_streams(tmp_path), pytest.raises(SystemExit) as ending:
        work(failing(error), SEAT, tmp_path / "log.txt")
    assert ending.value.code == 1
    text = (tmp_path / "log.txt").read_text()
    assert text.endswith(said)
    assert ("Traceback" in text) == traceback
    assert traceback or text == said

# SPDX-License-Identifier: Apache-2.0
"""What a task's program does: computes where it was reported to, and says why it failed."""

from pathlib import Path
from typing import Any

import pytest

from fake_tasks import Calls, Frames
from structgstream.errors import ConfigError, StorageError
from structgstream.evaluation.run_log import read_log
from structgstream.kernels.backend import Backend
from structgstream_studies.experiments.worker import command_of, main, work


def test_a_task_gets_its_back_end() -> None:
    seen: list[Any] = []
    assert work(Calls(lambda backend: seen.append(backend.name)), "reference") == 0
    assert seen == ["reference"]


def failing(error: BaseException) -> Calls:
    def call(backend: Backend) -> None:
        raise error

    return Calls(call)


@pytest.mark.parametrize(
    ("error", "said", "traceback"),
    [
        (ConfigError("The rate must be positive, got -1."), "calls: The rate must be positive, got -1.\n", False),
        (RuntimeError("out of paper"), "RuntimeError: out of paper\n", True),
    ],
    ids=["ours", "another"],
)
def test_a_task_that_fails_says_why(
    capsys: pytest.CaptureFixture[str], error: BaseException, said: str, traceback: bool
) -> None:
    assert work(failing(error), "reference") == 1
    text = capsys.readouterr().err
    assert text.endswith(said)
    assert ("Traceback" in text) == traceback
    assert traceback or text == said


def test_a_task_is_stored_for_its_command_which_runs_it(tmp_path: Path) -> None:
    task = Frames("three", tmp_path, frames=3)
    python, option, module, *arguments = command_of(task, "reference", folder=tmp_path / "tasks")
    assert (python, option, module) == ("{python}", "-m", "structgstream_studies.experiments.worker")
    assert main(arguments) == 0
    assert [entry["backend"] for entry in read_log(task.stream).values()] == ["reference"] * 3


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(StorageError, match="three.task cannot be written"):
        command_of(Frames("three", tmp_path), "reference", folder=tmp_path / "file")

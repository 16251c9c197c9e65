# SPDX-License-Identifier: Apache-2.0
"""Streams of the bundled clip that take seconds, for tests of commands."""

from typing import Any, Protocol

import pytest

from structgstream.cli import main
from tests.support.backends import QUICKEST
from tests.support.small_clip import small_clip_path

CLIP = str(small_clip_path())
SMALL = ["--frames", "3", "--scale", "0.25"]
QUICK = ["--preset", "tiny", "--device", QUICKEST, "--initial.iterations", "3", "--online.iterations", "2"]
QUICK += ["--online.patching.iteration", "1"]
QUARTER = ["--scale", "0.25", *QUICK]


class Runner(Protocol):
    """Runs a command, which ends with ``status``, and returns what it has printed: ``out`` and ``err``."""

    def __call__(self, arguments: list[str], *, status: int = 0) -> Any: ...


def runner_of(capsys: pytest.CaptureFixture[str]) -> Runner:
    """Also checks that there is never a traceback, nor an error that nobody expected."""

    def run(arguments: list[str], *, status: int = 0) -> Any:
        capsys.readouterr()
        assert main(arguments) == status
        printed = capsys.readouterr()
        assert "Traceback" not in printed.err
        assert "unexpected error" not in printed.err
        return printed

    return run


def error_of(arguments: list[str], capsys: pytest.CaptureFixture[str], *, status: int) -> str:
    """What a command that fails with ``status`` says."""
    return runner_of(capsys)(arguments, status=status).err

# SPDX-License-Identifier: Apache-2.0
"""Streams of the bundled clip that take seconds, for tests of commands."""

import pytest

from structgstream.cli import main
from tests.support.backends import QUICKEST
from tests.support.small_clip import small_clip_path

CLIP = str(small_clip_path())
SMALL = ["--frames", "3", "--scale", "0.25"]
QUICK = ["--preset", "tiny", "--device", QUICKEST, "--initial.iterations", "3", "--online.iterations", "2"]
QUICK += ["--online.patching.iteration", "1"]
QUARTER = ["--scale", "0.25", *QUICK]


def error_of(arguments: list[str], capsys: pytest.CaptureFixture[str], *, status: int) -> str:
    """What a command that fails with ``status`` says; never a traceback, nor that nobody expected this."""
    capsys.readouterr()
    assert main(arguments) == status
    error = capsys.readouterr().err
    assert "Traceback" not in error
    assert "unexpected error" not in error
    return error

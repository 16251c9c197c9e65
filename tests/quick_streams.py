# SPDX-License-Identifier: Apache-2.0
"""Streams of the bundled clip that take seconds, for tests of commands."""

import pytest

from backends import QUICKEST
from structgstream.cli import main
from structgstream.data.clip import bundled_clip_path

CLIP = str(bundled_clip_path())
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

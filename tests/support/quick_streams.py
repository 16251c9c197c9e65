# SPDX-License-Identifier: Apache-2.0
"""Streams of the bundled clip that take seconds, for tests of commands."""

import signal
import subprocess
import sys
import time
from pathlib import Path

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


def stopped_by_sigterm(arguments: list[str], *, written: Path) -> str:
    """What a command says that gets SIGTERM when the file ``written`` is there; its status is 143."""
    # The fixture that gives few points does not reach another process.
    command = [sys.executable, "-m", "structgstream", *arguments, "--points.max-points", "1500"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL)
    try:
        while not written.is_file() and process.poll() is None:
            time.sleep(0.02)
        process.send_signal(signal.SIGTERM)
        _, error = process.communicate(timeout=300)
    finally:
        process.kill()
    assert process.returncode == 143, error
    return error.decode()

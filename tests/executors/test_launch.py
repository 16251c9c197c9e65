# SPDX-License-Identifier: Apache-2.0
"""The launcher becomes its command, and does not outlive the process that began it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from structgstream.executors import launch

LAUNCH = [sys.executable, "-I", "-S", launch.__file__]
LINUX = pytest.mark.skipif(sys.platform != "linux", reason="only Linux ends a process with its parent")


def launched(*command: str, parent: int | None = None) -> subprocess.CompletedProcess[str]:
    tied = str(os.getpid() if parent is None else parent)
    return subprocess.run([*LAUNCH, tied, *command], capture_output=True, text=True, check=False)


def test_it_becomes_the_command_with_its_words_and_status() -> None:
    done = launched("sh", "-c", 'echo "$0 and $1"; exit 3', "two words", "*")
    assert (done.returncode, done.stdout, done.stderr) == (3, "two words and *\n", "")


def test_it_is_the_same_process() -> None:
    process = subprocess.Popen([*LAUNCH, str(os.getpid()), "sh", "-c", "echo $$"], stdout=subprocess.PIPE, text=True)
    assert process.communicate()[0] == f"{process.pid}\n"


@LINUX
def test_a_parent_that_has_ended_before_begins_nothing(tmp_path: Path) -> None:
    done = launched("touch", str(tmp_path / "begun"), parent=1)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert not (tmp_path / "begun").exists()

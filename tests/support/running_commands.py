# SPDX-License-Identifier: Apache-2.0
"""A command in a process of its own, as a user has it in a terminal."""

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

PATIENCE_SECONDS = 60.0
# As `python -m structgstream`, with Ctrl-C as a terminal has it: whoever starts the tests in the background has it
# ignored, and children inherit that.
PROGRAM = """
import runpy, signal
signal.signal(signal.SIGINT, signal.default_int_handler)
runpy.run_module("structgstream", run_name="__main__", alter_sys=True)
"""


@dataclass
class RunningCommand:
    """The process, and the file that it prints into."""

    process: "subprocess.Popen[bytes]"
    printed: Path

    def said(self, pattern: str) -> str:
        """What matches ``pattern``, once it is printed."""
        last = time.monotonic() + PATIENCE_SECONDS
        while time.monotonic() < last:
            if found := re.search(pattern, self.printed.read_text()):
                return found[0]
            time.sleep(0.1)
        raise AssertionError(f"no {pattern} in {self.printed.read_text()!r}")

    def address(self) -> str:
        """The address that is announced."""
        return self.said(r"http://127\.0\.0\.1:\d+/")

    def ended_by(self, number: signal.Signals) -> int:
        """Sends a signal; gives back the exit status."""
        self.process.send_signal(number)
        return self.process.wait(PATIENCE_SECONDS)


@contextmanager
def running_command(folder: Path, *arguments: str) -> Iterator[RunningCommand]:
    """The command, which prints into a file of ``folder``, on a machine without a screen."""
    environ = {name: text for name, text in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER")}
    printed = folder / "printed"
    with printed.open("wb") as output:
        process = subprocess.Popen(
            [sys.executable, "-c", PROGRAM, *arguments], stdout=output, stderr=output, env=environ
        )
    try:
        yield RunningCommand(process, printed)
    finally:
        process.kill()
        process.wait()

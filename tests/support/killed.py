# SPDX-License-Identifier: Apache-2.0
"""What a process leaves that is killed between any two of its operations on files."""

import os
import signal
import sys
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path
from types import FrameType

from tests.support.properties import THOROUGH

_LOOKS = {"stat", "lstat", "fstat", "fspath", "getpid", "getcwd", "listdir", "scandir", "access", "get_terminal_size"}
MOST = 500


def folders_of_the_killed(
    root: Path, act: Callable[[Path], object], *, begin: Callable[[Path], object], thin: bool = False
) -> list[Path]:
    """A folder for each operation that ``act`` would have done next, and at last the one in which it came to its end.

    Args:
        root: holds the folders.
        act: is run in a process for each, on the folder; it is killed at once, so that what it has not flushed is lost.
        begin: makes a folder what it is before.
        thin: only every fourth operation, unless the run is thorough (``properties``).
    """
    folders = []
    for number in range(1, MOST, 4 if thin and not THOROUGH else 1):
        folder = root / f"killed-{number:03d}"
        folder.mkdir()
        begin(folder)
        folders.append(folder)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # What threads of this process hold, the other one does not need.
            child = os.fork()
        if not child:
            _act(act, folder, number)
        _, status = os.waitpid(child, 0)
        if status == 0:
            return folders
        assert os.WIFSIGNALED(status), f"operation {number} failed"
        assert os.WTERMSIG(status) == signal.SIGKILL
    raise AssertionError(f"more than {MOST} operations")


def _act(act: Callable[[Path], object], folder: Path, number: int) -> None:
    """Runs in a process of its own, which ends here or in the midst of it."""
    left = number

    def watch(frame: FrameType, event: str, called: object) -> None:
        nonlocal left
        if event == "c_call" and _changes_files(called):
            left -= 1
            if not left:
                os.kill(os.getpid(), signal.SIGKILL)

    try:
        sys.setprofile(watch)
        act(folder)
        sys.setprofile(None)
    except BaseException:
        sys.setprofile(None)
        traceback.print_exc()
        os._exit(1)
    os._exit(0)


def _changes_files(called: object) -> bool:
    module = getattr(called, "__module__", None) or type(getattr(called, "__self__", None)).__module__
    return module in ("posix", "fcntl", "_io") and getattr(called, "__name__", "") not in _LOOKS

# SPDX-License-Identifier: Apache-2.0
"""What the processes of one test run share: made by the first that needs it, read by all, removed at the end."""

import fcntl
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from tempfile import mkdtemp

VARIABLE = "STRUCTGSTREAM_TEST_FOLDER"


def open_shared_folder() -> Path | None:
    """Make the folder of this run; None in a process that another one of the run has started."""
    if VARIABLE in os.environ:
        return None
    os.environ[VARIABLE] = mkdtemp(prefix="structgstream-tests-")
    return Path(os.environ[VARIABLE])


def made_once(name: str, make: Callable[[Path], object]) -> Path:
    """The folder ``name`` of this run, filled by ``make`` in the process that needs it first; nobody changes it."""
    open_shared_folder()
    folder = Path(os.environ[VARIABLE], name)
    complete = folder.with_name(f"{name}.complete")
    with folder.with_name(f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not complete.exists():
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            make(folder)
            complete.touch()
    return folder

# SPDX-License-Identifier: Apache-2.0
"""Locks on open files, by which processes keep out of each other's way; each ends with its process, in any way."""

import errno
import fcntl
from typing import IO, Any, Literal

_HELD = (errno.EACCES, errno.EAGAIN)  # what POSIX lets a system say of a lock that another has


def lock_file(file: IO[Any], *, holder: Literal["file", "process"] = "file") -> bool:
    """Takes the lock of ``file``, which must be open for writing; False if another has it.

    A file system without locks, as some networks' are, gives every lock to everyone.

    Args:
        file: keeps the lock until it is closed.
        holder: who has the lock: this open file, so that a second one in the same process is refused, or the process.
    """
    take = fcntl.flock if holder == "file" else fcntl.lockf
    try:
        take(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        return error.errno not in _HELD
    return True

# SPDX-License-Identifier: Apache-2.0
"""Locks on open files, by which processes keep out of each other's way; each ends with its process, in any way."""

import errno
import fcntl
import os
from pathlib import Path
from typing import IO, Any, BinaryIO, Literal, cast

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


def open_lockable(path: Path, *, buffering: int = -1) -> BinaryIO:
    """The file ``path``, made if it is missing, open for writing at its beginning; what is in it stays.

    A link is followed to a device only: a file that it points to is another's.

    Raises:
        OSError: it cannot be opened, or is a link.
    """
    if path.is_symlink() and not path.is_char_device():
        raise OSError(errno.ELOOP, f"{path.name} in it is a link, which is not followed", str(path))
    return cast(BinaryIO, os.fdopen(os.open(path, os.O_RDWR | os.O_CREAT | os.O_NONBLOCK, 0o666), "wb", buffering))

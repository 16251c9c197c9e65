# SPDX-License-Identifier: Apache-2.0
"""Locks on open files between processes; a lock ends with its process."""

import errno
import fcntl
import os
from pathlib import Path
from typing import IO, Any, BinaryIO, Literal, cast

_HELD = (errno.EACCES, errno.EAGAIN)  # the errors that POSIX allows for a lock that is held


def lock_file(file: IO[Any], *, holder: Literal["file", "process"] = "file") -> bool:
    """Acquires the lock of ``file``, which must be open for writing; returns False if it is held already.

    On a file system without locks, such as some network file systems, it always succeeds.

    Args:
        file: holds the lock until it is closed.
        holder: the owner of the lock: the open file, so that a second one in the same process is refused, or the
            process.
    """
    take = fcntl.flock if holder == "file" else fcntl.lockf
    try:
        take(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        return error.errno not in _HELD
    return True


def open_lockable(path: Path, *, buffering: int = -1) -> BinaryIO:
    """The file ``path``, created if it is missing, open for writing at its beginning and not truncated.

    A link is followed only to a device, because a file that it points to may belong to somebody else.

    Raises:
        OSError: it cannot be opened, or is a link.
    """
    if path.is_symlink() and not path.is_char_device():
        raise OSError(errno.ELOOP, f"{path.name} in it is a link, which is not followed", str(path))
    return cast(BinaryIO, os.fdopen(os.open(path, os.O_RDWR | os.O_CREAT | os.O_NONBLOCK, 0o666), "wb", buffering))

# SPDX-License-Identifier: Apache-2.0
"""Names that an address may contain, and opening of files below a folder, never outside it.

Note [Plain names]
~~~~~~~~~~~~~~~~~~
Names of streams and their files consist of letters, digits, dots, dashes and underscores. So every address has a single
spelling, without percent signs, and no address leads out of a folder.

Note [No links]
~~~~~~~~~~~~~~~
Each part of a path is opened relative to the folder before it, and none may be a symbolic link. So a folder cannot be
replaced by a link between check and opening. Only regular files are opened; opening a pipe does not wait for its
writer.
"""

import errno
import os
import re
import stat
import weakref
from dataclasses import dataclass
from io import FileIO
from pathlib import Path
from typing import Final

from structgstream.codec.segments.manifest import MANIFEST
from structgstream.codec.segments.store import is_ours

STREAM_SUFFIX: Final = ".sgs"

_STREAM = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9._-]{0,127}", re.ASCII)
_PATH = re.compile(rb"/[A-Za-z0-9._/-]*")
_MISSING = {errno.ENOENT, errno.ENOTDIR, errno.ELOOP, errno.EACCES, errno.ENXIO, errno.ENAMETOOLONG, errno.EISDIR}
_SAFELY = os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK


def is_stream_name(name: str) -> bool:
    """Whether a stream of this name can be served (Note [Plain names])."""
    return _STREAM.fullmatch(name) is not None


def hash_in_name(file: str) -> str | None:
    """The 16 hex digits in the name of an immutable file of a segments folder; None for other names."""
    return None if file == MANIFEST or not is_ours(file) else file.rpartition("-")[2].partition(".")[0]


def is_plain_path(raw: bytes) -> bool:
    """Whether a path, as the client wrote it, consists of plain names (Note [Plain names])."""
    return _PATH.fullmatch(raw) is not None and not {b".", b".."} & set(raw.split(b"/"))


@dataclass(frozen=True)
class FileStamp:
    """Properties of a file that change when it is replaced or grows."""

    inode: int
    modified_ns: int
    size_bytes: int


@dataclass(frozen=True)
class OpenedFile:
    """A regular file at its length when it was opened; closed by :meth:`close` or when the object is collected."""

    file: FileIO
    stamp: FileStamp

    def __len__(self) -> int:
        return self.stamp.size_bytes

    def __getitem__(self, key: slice, /) -> bytes:
        start, stop, _ = key.indices(len(self))
        return self.read(start, max(stop - start, 0))

    def read(self, start: int, count: int) -> bytes:
        """Up to ``count`` bytes from ``start`` on; fewer if the file has become shorter."""
        pieces = []
        while count and (piece := os.pread(self.file.fileno(), count, start)):
            pieces.append(piece)
            start, count = start + len(piece), count - len(piece)
        return pieces[0] if len(pieces) == 1 else b"".join(pieces)

    def close(self) -> None:
        """Closes the file."""
        self.file.close()

    def __enter__(self) -> "OpenedFile":
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()


def open_below(folder: Path, *parts: str) -> OpenedFile | None:
    """The regular file ``folder/parts[0]/...``; None if there is none that may be read (Note [No links]).

    Args:
        folder: may itself be a link, because the user named it.
        parts: at least one plain name.

    Raises:
        OSError: the system cannot open files now.
    """
    try:
        handle = _opened(folder, parts)
    except OSError as error:
        if error.errno in _MISSING:
            return None
        raise
    status = os.fstat(handle)
    if not stat.S_ISREG(status.st_mode):
        os.close(handle)
        return None
    file = FileIO(handle, "rb")
    opened = OpenedFile(file, FileStamp(status.st_ino, status.st_mtime_ns, status.st_size))
    # A request may be cancelled between the opening in a thread and the receipt of its result.
    weakref.finalize(opened, file.close)
    return opened


def _opened(folder: Path, parts: tuple[str, ...]) -> int:
    """A file descriptor."""
    assert all(part not in ("", ".", "..") and "/" not in part for part in parts), "parts are plain names"
    handle = os.open(folder, os.O_RDONLY | os.O_CLOEXEC | os.O_DIRECTORY)
    for part, kind in zip(parts, [os.O_DIRECTORY] * (len(parts) - 1) + [0], strict=True):
        try:
            inner = os.open(part, _SAFELY | kind, dir_fd=handle)
        finally:
            os.close(handle)
        handle = inner
    return handle

# SPDX-License-Identifier: Apache-2.0
"""Files that have their name only when they are whole, and locks on those that are being written."""

import errno
import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from structgstream.errors import StorageError


def partial_path(path: Path) -> Path:
    """The name of a file while it is written."""
    return path.with_name(f"{path.name}.partial")


def write_whole(path: Path, data: bytes) -> None:
    """Writes a small file, whole or not at all.

    Raises:
        StorageError: it cannot be written.
    """
    with whole_file(path) as file:
        file.write(data)


@contextmanager
def whole_file(path: Path) -> Iterator[BinaryIO]:
    """A file that gets the name ``path`` at the end of the block, if that is reached.

    Raises:
        StorageError: it cannot be written.
    """
    partial = partial_path(path)
    try:
        with partial.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        give_name(partial, path)
    except OSError as error:
        raise StorageError(f"{path} cannot be written ({error.strerror}); make room or mend permissions.") from error
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)


def give_name(partial: Path, path: Path) -> None:
    """Renames a written and synced file, and syncs the folder, so that the name is there after a power cut."""
    partial.replace(path)
    with suppress(OSError):  # Some file systems cannot sync folders.
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


class GrowingFile:
    """A file that grows under the name ``PATH.partial``, locked, and gets its own name at the end.

    What :meth:`append` has returned from is on the disk, and a failed write is cut off.

    Args:
        path: of the finished file.
        keep: bytes that are there and stay; what follows them is cut off.

    Raises:
        StorageError: it cannot be written, another process writes it, or has changed it since ``keep`` was found.
    """

    def __init__(self, path: Path, *, keep: int = 0) -> None:
        self.path, self.partial = path, partial_path(path)
        try:
            descriptor = os.open(self.partial, os.O_RDWR | os.O_CREAT, 0o666)
            self._file = os.fdopen(descriptor, "rb+", buffering=0)
            try:
                self._begin(keep)
            except BaseException:
                self._file.close()
                raise
        except OSError as error:
            raise self._failed(error) from error
        self.size = keep

    def _begin(self, keep: int) -> None:
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in (errno.EACCES, errno.EAGAIN):
                raise StorageError(
                    f"Another process writes {self.path}; wait for its end, or give another name with -o."
                ) from error
            # A file system without locks, as some networks' are.
        if self._file.seek(0, os.SEEK_END) < keep:
            raise StorageError(f"Another process has changed {self.partial}; give the same command again.")
        self._file.truncate(keep)
        self._file.seek(keep)

    def append(self, data: bytes) -> int:
        """Adds ``data``; returns its length.

        Raises:
            StorageError: it cannot be written; what was there before stays.
        """
        try:
            rest = memoryview(data)
            while rest:
                rest = rest[self._file.write(rest) :]
            os.fsync(self._file.fileno())
        except OSError as error:
            with suppress(OSError):
                self._file.truncate(self.size)
                self._file.seek(self.size)
            raise self._failed(error) from error
        self.size += len(data)
        return len(data)

    def finish(self) -> None:
        """Gives the file its name, and closes it.

        Raises:
            StorageError: it cannot be renamed.
        """
        try:
            give_name(self.partial, self.path)
        except OSError as error:
            raise self._failed(error) from error
        finally:
            self.close()

    def close(self) -> None:
        """Closes the file, which may go on later. A second call does nothing."""
        self._file.close()

    def _failed(self, error: OSError) -> StorageError:
        return StorageError(
            f"{self.partial} cannot be written ({error.strerror}); make room or mend permissions, and give the same "
            "command again."
        )

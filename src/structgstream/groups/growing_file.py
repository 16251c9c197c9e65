# SPDX-License-Identifier: Apache-2.0
"""Files that grow, and go on growing after an interruption, under another name until they are whole."""

import os
from contextlib import suppress
from pathlib import Path

from structgstream.errors import StorageError
from structgstream.whole_files import give_name, open_alone, partial_path


def name_finished(path: Path) -> None:
    """Gives a file its name that is whole under the other one: who wrote it was killed just before that.

    Raises:
        StorageError: it cannot be renamed, or another process writes it.
    """
    partial = partial_path(path)
    GrowingFile(path, keep=partial.stat().st_size if partial.exists() else 0).finish()


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
            self._file = open_alone(self.partial, of=path, buffering=0)
            try:
                self._begin(keep)
            except BaseException:
                self._file.close()
                raise
        except OSError as error:
            raise self._failed(error) from error
        self.size = keep

    def _begin(self, keep: int) -> None:
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

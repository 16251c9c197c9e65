# SPDX-License-Identifier: Apache-2.0
"""Append-only files that can be resumed, and have a temporary name until they are complete."""

import os
from contextlib import suppress
from pathlib import Path

from structgstream.atomic_files import give_name, open_exclusive, partial_path
from structgstream.errors import StorageError


def name_finished(path: Path) -> None:
    """Renames a complete file whose writer was killed just before it renamed it.

    Raises:
        StorageError: it cannot be renamed, or another process writes it.
    """
    partial = partial_path(path)
    GrowingFile(path, keep=partial.stat().st_size if partial.exists() else 0).finish()


class GrowingFile:
    """A locked file that grows under the name ``PATH.partial`` and is renamed at the end.

    Data is on the disk when :meth:`append` returns; a failed write is truncated.

    Args:
        path: of the finished file.
        keep: existing bytes to retain; the file is truncated after them.

    Raises:
        StorageError: it cannot be written, another process writes it, or has changed it since ``keep`` was found.
    """

    def __init__(self, path: Path, *, keep: int = 0) -> None:
        self.path, self.partial = path, partial_path(path)
        try:
            self._file = open_exclusive(self.partial, of=path, buffering=0)
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
            raise StorageError(f"Another process has changed {self.partial}; run the same command again.")
        self._file.truncate(keep)
        self._file.seek(keep)

    def append(self, data: bytes) -> int:
        """Adds ``data``; returns its length.

        Raises:
            StorageError: it cannot be written; earlier data stays.
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
        """Renames the file to its final name and closes it.

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
        """Closes the file, which can be resumed later. A second call does nothing."""
        self._file.close()

    def _failed(self, error: OSError) -> StorageError:
        return StorageError(
            f"{self.partial} cannot be written ({error.strerror}); make room or correct its permissions, and "
            "run the same command again."
        )

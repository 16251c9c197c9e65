# SPDX-License-Identifier: Apache-2.0
"""Where a stream's segments lie: a folder here; an object store in ``cloud_store``."""

import os
import re
import weakref
from pathlib import Path
from typing import Protocol

from structgstream.codec.container.disk_room import free_bytes
from structgstream.errors import StorageError, StreamError
from structgstream.file_locks import lock_file, open_lockable
from structgstream.whole_files import replacing

_TEMPORARY = ".new-"
_LOCK = ".writer"
_OURS = re.compile(r"manifest\.json|(init|part|segment)-\d{4,}-[0-9a-f]{16}\.sgs|history-\d{8,}-[0-9a-f]{16}\.json")


def is_ours(name: str) -> bool:
    """Whether a file has a name that the sink gives; nothing else in a folder is ever touched."""
    return _OURS.fullmatch(name) is not None


class Store(Protocol):
    """Named files without folders. A file that :meth:`put` has returned from is whole and survives a power cut."""

    @property
    def name(self) -> str:
        """For messages."""
        ...

    def put(self, name: str, data: bytes) -> None:
        """Write a file, or replace it in one step: readers see the old bytes or the new ones.

        Raises:
            StorageError: it cannot be written; what was there before stays.
        """
        ...

    def get(self, name: str) -> bytes:
        """The bytes of a file.

        Raises:
            StreamError: there is none, or it cannot be read.
        """
        ...

    def delete(self, name: str) -> None:
        """Remove a file if it is there.

        Raises:
            StorageError: it cannot be removed.
        """
        ...

    def names(self) -> frozenset[str]:
        """The names of all files that a sink has made.

        Raises:
            StreamError: they cannot be listed.
        """
        ...

    def free_bytes(self) -> int | None:
        """Room that is left; None if that is not known or not bounded."""
        ...


class FolderStore:
    """A folder. A file is written under a temporary name, synced, and renamed; then the folder is synced."""

    def __init__(self, folder: Path | str) -> None:
        self.folder = Path(folder)

    @property
    def name(self) -> str:
        """The folder."""
        return str(self.folder)

    def make(self) -> None:
        """Make the folder, if it is not there.

        Raises:
            StorageError: it cannot be made, or it is a file.
        """
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise StorageError(f"The folder {self.folder} cannot be made ({error.strerror}).") from error

    def prepare(self) -> None:
        """Make the folder, and remove the temporary files of a writer that was killed.

        Raises:
            StorageError: the folder cannot be made or changed, or it is a file.
        """
        self.make()
        try:
            for path in self.folder.glob(f"{_TEMPORARY}*"):
                path.unlink(missing_ok=True)
        except OSError as error:
            raise StorageError(f"{self.folder} cannot be changed ({error.strerror}).") from error

    def lock(self) -> None:
        """Keep other processes from writing here, until this one ends or forgets the store.

        Raises:
            StorageError: another process writes here, or the lock's file cannot be opened, or is a link.
        """
        path = self.folder / _LOCK
        try:
            file = open_lockable(path)
        except OSError as error:
            raise StorageError(f"{self.folder} cannot be written ({error.strerror}).") from error
        if not lock_file(file, holder="process"):
            file.close()
            raise StorageError(f"Another process writes to {self.folder}; wait for its end, or choose another folder.")
        weakref.finalize(self, file.close)

    def put(self, name: str, data: bytes) -> None:
        """See :meth:`Store.put`."""
        try:
            with replacing(self.folder / name, partial=self.folder / f"{_TEMPORARY}{name}") as file:
                file.write(data)
        except OSError as error:
            raise StorageError(
                f"Cannot write {len(data)} bytes to {self.folder / name} ({error.strerror or error})."
            ) from error

    def get(self, name: str) -> bytes:
        """See :meth:`Store.get`."""
        path = self.folder / name
        try:
            return path.read_bytes()
        except OSError as error:
            raise StreamError(f"Cannot read {path} ({error.strerror}).") from error

    def delete(self, name: str) -> None:
        """See :meth:`Store.delete`."""
        try:
            (self.folder / name).unlink(missing_ok=True)
        except OSError as error:
            raise StorageError(f"Cannot remove {self.folder / name} ({error.strerror}).") from error

    def names(self) -> frozenset[str]:
        """See :meth:`Store.names`."""
        try:
            return frozenset(filter(is_ours, os.listdir(self.folder)))
        except FileNotFoundError:
            return frozenset()
        except OSError as error:
            raise StreamError(f"Cannot list {self.folder} ({error.strerror}).") from error

    def free_bytes(self) -> int | None:
        """What an ordinary user may still write to the folder's disk."""
        return free_bytes(self.folder)

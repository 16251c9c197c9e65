# SPDX-License-Identifier: Apache-2.0
"""Where a stream's segments lie: a folder, or an object store."""

import os
import re
import stat
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

from structgstream.atomic_files import lock_file, open_lockable, replacing
from structgstream.codec.container.byte_source import free_bytes
from structgstream.codec.segments.manifest import MANIFEST
from structgstream.errors import StorageError, StreamError
from structgstream.owned_folders import MARKER
from structgstream.remote_folders import open_url, reason_of, shown_address

MAX_FILE_BYTES = 2**32
"""Of a file whose size no manifest states."""
_TEMPORARY = ".new-"
_LOCK = ".writer"
_OURS = re.compile(r"manifest\.json|(init|part|segment)-\d{4,}-[0-9a-f]{16}\.sgs|history-\d{8,}-[0-9a-f]{16}\.json")


def is_ours(name: str) -> bool:
    """Whether a file has a name that the sink gives; nothing else in a folder is ever touched."""
    return _OURS.fullmatch(name) is not None


def read_bounded(path: Path, *, max_bytes: int) -> bytes:
    """The bytes of a regular file; pipes, devices and files that are too large are refused before they are read. Raises
    StreamError if it cannot be read, is no regular file, or has more bytes."""
    try:
        with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
            status = os.fstat(file.fileno())
            if not stat.S_ISREG(status.st_mode):
                raise StreamError(f"{path} is not a regular file; expected one that a run has written.")
            data = file.read(max_bytes + 1) if status.st_size <= max_bytes else None
    except OSError as error:
        raise StreamError(f"Cannot read {path} ({error.strerror}).") from error
    if data is None or len(data) > max_bytes:
        raise StreamError(f"{path} has {status.st_size} bytes; expected at most {max_bytes}.")
    return data


class Store(Protocol):
    """Named files without folders. A file that :meth:`put` has returned from is whole and survives a power cut."""

    @property
    def name(self) -> str:
        """For messages."""
        ...

    def put(self, name: str, data: bytes) -> None:
        """Write a file, or replace it in one step: readers see the old bytes or the new ones. Raises StorageError if it
        cannot be written; what was there before stays."""
        ...

    def get(self, name: str, *, max_bytes: int | None = None) -> bytes:
        """The bytes of a file. Raises StreamError if there is none, or it cannot be read, or has more bytes than
        ``max_bytes``."""
        ...

    def delete(self, name: str) -> None:
        """Remove a file if it is there. Raises StorageError if it cannot be removed."""
        ...

    def names(self) -> frozenset[str]:
        """The names of all files that a sink has made. Raises StreamError if they cannot be listed."""
        ...

    def free_bytes(self) -> int | None:
        """Room that is left; None if that is not known or not bounded."""
        ...


@contextmanager
def _storage_errors(what: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise StorageError(f"{what} ({error.strerror or error}).") from error


class FolderStore:
    """A folder. A file is written under a temporary name, synced, and renamed; then the folder is synced."""

    def __init__(self, folder: Path | str) -> None:
        self.folder = Path(folder)

    @property
    def name(self) -> str:
        """The folder."""
        return str(self.folder)

    def make(self) -> None:
        """Make the folder, if it is not there. Raises StorageError if it cannot be made, or it is a file."""
        with _storage_errors(f"The folder {self.folder} cannot be made"):
            self.folder.mkdir(parents=True, exist_ok=True)

    def prepare(self) -> None:
        """Make the folder, and remove the temporary files of a writer that was killed. Raises StorageError if the
        folder cannot be made or changed, or it is a file."""
        self.make()
        with _storage_errors(f"{self.folder} cannot be changed"):
            for path in self.folder.glob(f"{_TEMPORARY}*"):
                name = path.name.removeprefix(_TEMPORARY)
                if is_ours(name) or name == MARKER:
                    path.unlink(missing_ok=True)

    def lock(self) -> None:
        """Keep other processes from writing here, until this one ends or forgets the store. Raises StorageError if
        another process writes here, or the lock's file cannot be opened, or is a link."""
        with _storage_errors(f"{self.folder} cannot be written"):
            file = open_lockable(self.folder / _LOCK)
        if not lock_file(file, holder="process"):
            file.close()
            raise StorageError(f"Another process writes to {self.folder}; wait for its end, or choose another folder.")
        weakref.finalize(self, file.close)

    def put(self, name: str, data: bytes) -> None:
        path, temporary = self.folder / name, self.folder / f"{_TEMPORARY}{name}"
        with _storage_errors(f"Cannot write {len(data)} bytes to {path}"), replacing(path, partial=temporary) as file:
            file.write(data)

    def get(self, name: str, *, max_bytes: int | None = None) -> bytes:
        return read_bounded(self.folder / name, max_bytes=MAX_FILE_BYTES if max_bytes is None else max_bytes)

    def delete(self, name: str) -> None:
        with _storage_errors(f"Cannot remove {self.folder / name}"):
            (self.folder / name).unlink(missing_ok=True)

    def names(self) -> frozenset[str]:
        try:
            return frozenset(filter(is_ours, os.listdir(self.folder)))
        except FileNotFoundError:
            return frozenset()
        except OSError as error:
            raise StreamError(f"Cannot list {self.folder} ({error.strerror}).") from error

    def free_bytes(self) -> int | None:
        """What an ordinary user may still write to the folder's disk."""
        return free_bytes(self.folder)


IMMUTABLE = "public, max-age=31536000, immutable"
"""Cache-Control of everything but the manifest."""
ALWAYS_ASK = "no-cache"
"""Cache-Control of the manifest."""
_ATOMIC = ("s3", "s3a", "gcs", "gs", "abfs", "az", "adl", "memory")


class CloudStore:
    """A folder of a URL such as ``s3://bucket/streams/studio``, with options of the file system (``open_url``).

    Object stores write an object in one step and durably. Elsewhere (sftp and the like) a file is written under a
    temporary name and moved. S3 gets content types and cache headers, so that the bucket can be read by browsers.
    """

    def __init__(self, url: str, **options: Any) -> None:
        self._url = url.rstrip("/")
        self.name = shown_address(self._url)
        self._files, self._root = open_url(self._url, **options)
        protocols = self._files.protocol
        self._scheme = protocols if isinstance(protocols, str) else protocols[0]

    def put(self, name: str, data: bytes) -> None:
        path = f"{self._root}/{name}"
        with self._writing(f"write {len(data)} bytes to {name}"):
            if self._scheme in _ATOMIC:
                self._files.pipe_file(path, data, **self._headers(name))
            else:
                temporary = f"{self._root}/.new-{name}"
                self._files.makedirs(self._root, exist_ok=True)
                self._files.pipe_file(temporary, data)
                self._files.mv(temporary, path)

    def get(self, name: str, *, max_bytes: int | None = None) -> bytes:
        end = None if max_bytes is None else max_bytes + 1
        try:
            data = self._files.cat_file(f"{self._root}/{name}", end=end)
        except Exception as error:
            raise StreamError(f"Cannot read {name} in {self.name} ({reason_of(error, self._url)}).") from error
        if max_bytes is not None and len(data) > max_bytes:
            raise StreamError(f"{name} in {self.name} has more than the expected {max_bytes} bytes.")
        return data

    def delete(self, name: str) -> None:
        with self._writing(f"remove {name}"):
            try:
                self._files.rm_file(f"{self._root}/{name}")
            except FileNotFoundError:
                return

    def names(self) -> frozenset[str]:
        try:
            self._files.invalidate_cache()
            found = self._files.ls(self._root, detail=False)
        except FileNotFoundError:
            return frozenset()
        except Exception as error:
            raise StreamError(f"Cannot list {self.name} ({reason_of(error, self._url)}).") from error
        return frozenset(filter(is_ours, (str(path).rsplit("/", 1)[-1] for path in found)))

    def free_bytes(self) -> int | None:
        """Object stores do not say."""
        return None

    def _headers(self, name: str) -> dict[str, str]:
        if not self._scheme.startswith("s3"):
            return {}
        kind = "application/json" if name.endswith(".json") else "application/octet-stream"
        return {"ContentType": kind, "CacheControl": ALWAYS_ASK if name == MANIFEST else IMMUTABLE}

    @contextmanager
    def _writing(self, what: str) -> Iterator[None]:
        try:
            yield
        except Exception as error:
            raise StorageError(f"Cannot {what} in {self.name} ({reason_of(error, self._url)}).") from error

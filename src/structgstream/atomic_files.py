# SPDX-License-Identifier: Apache-2.0
"""Atomic writes of files, files that grow, and locks on open files between processes, which end with the process.

Note [Atomic files]
~~~~~~~~~~~~~~~~~~
A file is written as ``PATH.partial`` and renamed, so a reader of ``PATH`` gets the old or the complete new content,
even if the process is killed. The content is synced before the renaming; otherwise the file may be empty after a power
cut. The folder is synced after it; otherwise the name may refer to the old file. The next writer overwrites the partial
file of a killed process. The partial file is locked, because concurrent writers would mix their content.
"""

import errno
import fcntl
import io
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any, BinaryIO, Literal, cast

from structgstream.errors import StorageError

_HELD = (errno.EACCES, errno.EAGAIN)  # the errors that POSIX allows for a lock that is held


def lock_file(file: IO[Any], *, holder: Literal["file", "process"] = "file") -> bool:
    """Acquires the lock of ``file``, which must be open for writing, until it is closed; returns False if it is held
    already.

    The holder is the open file, so that a second one in the same process is refused, or the process. On a file system
    without locks, such as some network file systems, it always succeeds.
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


_WITHOUT_SYNC = (errno.EINVAL, errno.ENOTSUP, errno.EACCES, errno.EPERM, errno.EBADF, errno.ENOSYS)
"""Errors of file systems that cannot sync a folder, and of folders without read permission."""
ADVICE = {
    errno.ENOSPC: "; make room",
    errno.EDQUOT: "; make room",
    errno.EACCES: "; correct its permissions, or choose another place",
    errno.EPERM: "; correct its permissions, or choose another place",
    errno.EROFS: "; choose another place",
}
"""What to do about a file that cannot be written, by the error of the system."""


def partial_path(path: Path) -> Path:
    """The name of a file while it is written."""
    return path.with_name(f"{path.name}.partial")


def side_path(stream: Path, ending: str) -> Path:
    """A side file of a stream, by its name without ``.sgs``: ``a.b.log.jsonl`` for ``a.b`` and ``a.b.sgs``."""
    stream = stream if stream.name else stream.absolute()  # "." has no name
    return stream.with_name(f"{stream.name.removesuffix('.sgs')}{ending}")


def atomic_write(
    path: Path,
    content: bytes | Iterable[bytes | memoryview],
    *,
    called: str = "",
    new_folder: bool = False,
    sync: bool = True,
) -> None:
    """Writes or replaces the file ``path`` atomically (Note [Atomic files]).

    Args:
        content: its bytes, or an iterable of pieces, whose errors are passed on.
        called: name of the file in messages, before its path: "The picture".
        new_folder: create its folder if it is missing.
        sync: return only when the file is on the disk and survives a power cut.

    Raises:
        StorageError: it cannot be written, or another process writes it; an existing file is not affected.
    """
    with _as_storage_error(path, called):
        if new_folder:
            path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path, sync=sync) as file:
            file.writelines([content] if isinstance(content, bytes) else content)


@contextmanager
def atomic_file(
    path: Path, *, check: Callable[[Path], object] | None = None, new_folder: bool = False
) -> Iterator[BinaryIO]:
    """A file that is renamed to ``path`` at the end of the block, unless it raises (Note [Atomic files]).

    Before that ``check`` is called with the path of the complete partial file; if it raises, an existing file is not
    affected. With ``new_folder`` a missing folder is created. Raises StorageError as :func:`atomic_write`.
    """
    with _as_storage_error(path, ""):
        if new_folder:
            path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as file:
            yield file
            if check is not None:
                file.flush()
                check(partial_path(path.resolve() if path.is_symlink() else path))


@contextmanager
def replacing(path: Path, *, partial: Path | None = None, sync: bool = True) -> Iterator[BinaryIO]:
    """As :func:`atomic_file`, but raises errors of the system unchanged; the file may have another name than that of
    :func:`partial_path` while it is written, and need not be synced to the disk before the block ends."""
    if path.exists() and not path.is_file() and not path.is_dir():
        with path.open("wb") as file:  # a pipe or a device, such as /dev/stdout, which must not become a file
            yield file
        return
    path = path.resolve() if path.is_symlink() else path  # The link is retained.
    partial = partial or partial_path(path)
    file = open_exclusive(partial, of=path)
    try:
        file.truncate()  # remains of a killed process
        yield file
        file.flush()
        if sync:
            os.fsync(file.fileno())
        partial.replace(path)
    except BaseException:
        with suppress(OSError):
            partial.unlink()
        with suppress(OSError):  # Closing raises the error of a full disk again.
            file.close()
        raise
    file.close()
    if sync:
        sync_folder(path.parent)


@contextmanager
def renamed_on_success(path: Path) -> Iterator[Path]:
    """The path of a partial file for the block to write; it is renamed to ``path`` at the end, unless the block raises.

    For writers that open and lock their file themselves. Raises StorageError if the file cannot be renamed.
    """
    partial = partial_path(path)
    try:
        yield partial
        with _as_storage_error(path, ""):
            give_name(partial, path)
    finally:
        with suppress(OSError):
            partial.unlink()


def open_exclusive(partial: Path, *, of: Path, buffering: int = -1) -> BinaryIO:
    """Opens the file ``partial`` of ``of``, created if it is missing, exclusively for writing, at its beginning and
    without truncation. Raises StorageError if another process writes it, OSError if it cannot be opened."""
    while True:
        file = open_lockable(partial, buffering=buffering)
        if not lock_file(file):
            file.close()
            raise StorageError(f"Another process writes {of}; wait for its end, or choose another name.")
        if _is_at(file, partial):
            return file
        file.close()  # The former lock holder has renamed or removed the file since it was opened here.


def give_name(partial: Path, path: Path) -> None:
    """Syncs the complete file ``partial``, renames it, and syncs the folder (Note [Atomic files]). Raises OSError if
    one of these operations failed."""
    _sync(partial)
    partial.replace(path)
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Syncs a folder, which makes new names in it durable, if the file system supports it. Raises OSError if the disk
    has failed."""
    try:
        _sync(folder)
    except OSError as error:
        if error.errno not in _WITHOUT_SYNC:
            raise


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _is_at(file: BinaryIO, path: Path) -> bool:
    """Whether ``path`` is the name of the open file."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except FileNotFoundError:
        return False


@contextmanager
def _as_storage_error(path: Path, called: str) -> Iterator[None]:
    """Converts errors of the system in the block to StorageError."""
    try:
        yield
    except OSError as error:
        reason = f"{path.parent} is a file" if os.path.isfile(path.parent) else error.strerror or str(error)
        name = f"{called} {path}".lstrip()
        raise StorageError(f"{name} cannot be written ({reason}){ADVICE.get(error.errno or 0, '')}.") from error


def name_finished(path: Path) -> None:
    """Renames a complete file whose writer was killed just before it renamed it. Raises StorageError if it cannot be
    renamed, or another process writes it."""
    partial = partial_path(path)
    GrowingFile(path, keep=partial.stat().st_size if partial.exists() else 0).finish()


def name_unfinished(path: Path) -> None:
    """Renames a finished file that is damaged, so that its writer continues it. Raises StorageError if it cannot be
    renamed."""
    try:
        path.replace(partial_path(path))
    except OSError as error:
        raise StorageError(f"{path} cannot be renamed ({error.strerror}); correct its permissions.") from None


def remove_unused(path: Path) -> None:
    """Removes a file and its partial file, if they exist. Raises StorageError if another process writes it, which would
    otherwise give the next writer's partial file its name, or it cannot be removed."""
    partial = partial_path(path)
    try:
        if partial.exists():
            with open_exclusive(partial, of=path):
                partial.unlink()
        path.unlink(missing_ok=True)
    except OSError as error:
        raise StorageError(f"{path} cannot be replaced ({error.strerror}); choose another name.") from error


def append_durably(file: BinaryIO, data: bytes, *, end: int) -> None:
    """Writes ``data`` to an unbuffered file from byte ``end`` on, and syncs it. Raises OSError if that fails; what was
    written of it is truncated."""
    try:
        file.seek(end)
        rest = memoryview(data)
        while rest:
            rest = rest[file.write(rest) :]
        with suppress(io.UnsupportedOperation):  # A file in memory has nothing to sync.
            os.fsync(file.fileno())
    except OSError:
        with suppress(OSError):  # If this fails too, readers stop at the incomplete record.
            file.truncate(end)
        raise


class GrowingFile:
    """A locked file that grows under the name ``PATH.partial``, after ``keep`` existing bytes, and is renamed at the
    end. A missing folder is created.

    Data is on the disk when :meth:`append` returns; a failed write is truncated. Raises StorageError if it cannot be
    written, another process writes it, or has changed it since ``keep`` was found.
    """

    def __init__(self, path: Path, *, keep: int = 0) -> None:
        self.path, self.partial = path, partial_path(path)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
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

    def append(self, data: bytes) -> int:
        """Adds ``data``; returns its length. Raises StorageError if it cannot be written; earlier data stays."""
        try:
            append_durably(self._file, data, end=self.size)
        except OSError as error:
            raise self._failed(error) from error
        self.size += len(data)
        return len(data)

    def finish(self) -> None:
        """Renames the file to its final name and closes it. Raises StorageError if it cannot be renamed."""
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

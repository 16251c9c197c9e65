# SPDX-License-Identifier: Apache-2.0
"""Files that are written whole or not at all.

Note [Whole files]
~~~~~~~~~~~~~~~~~~
A file is written as ``PATH.partial`` and renamed, so that whoever reads ``PATH`` reads what was there before or all of
the new one, whenever the process is killed. The content is synced before the renaming, or the name may be that of an
empty file after a power cut; the folder after it, or the name may be that of the old one. What a killed process has
left under the other name is overwritten by the next one that writes the file. Two that write at a time would mix, so
the file under the other name is locked.
"""

import errno
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from structgstream.errors import StorageError
from structgstream.file_locks import lock_file, open_lockable

_WITHOUT_SYNC = (errno.EINVAL, errno.ENOTSUP, errno.EACCES, errno.EPERM, errno.EBADF, errno.ENOSYS)
"""What file systems say that cannot sync a folder, and folders that may be written but not read."""
_ADVICE = {
    errno.ENOSPC: "; make room",
    errno.EDQUOT: "; make room",
    errno.EACCES: "; mend permissions, or choose another place",
    errno.EPERM: "; mend permissions, or choose another place",
    errno.EROFS: "; choose another place",
}


def partial_path(path: Path) -> Path:
    """The name of a file while it is written."""
    return path.with_name(f"{path.name}.partial")


def side_path(stream: Path, ending: str) -> Path:
    """The file beside a stream, by its whole name without ``.sgs``: ``a.b.log.jsonl`` for ``a.b`` and ``a.b.sgs``."""
    return stream.with_name(f"{stream.name.removesuffix('.sgs')}{ending}")


def write_whole(
    path: Path,
    content: bytes | Iterable[bytes | memoryview],
    *,
    called: str = "",
    new_folder: bool = False,
    sync: bool = True,
) -> None:
    """Writes the file ``path``, or replaces it in one step (Note [Whole files]).

    Args:
        path: the file.
        content: its bytes, or pieces of them in their order; what their iterator raises, this does, too.
        called: what messages call the file, before its path: "The picture".
        new_folder: whether its folder is made when it is missing.
        sync: whether it is on the disk on return, so that it outlives a power cut.

    Raises:
        StorageError: it cannot be written, or another process writes it; what was there before stays.
    """
    with _told(path, called):
        if new_folder:
            path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path, sync=sync) as file:
            file.writelines([content] if isinstance(content, bytes) else content)


@contextmanager
def whole_file(path: Path, *, check: Callable[[Path], object] | None = None) -> Iterator[BinaryIO]:
    """A file that gets the name ``path`` at the end of the block, if that is reached (Note [Whole files]).

    Args:
        path: the file.
        check: called with the name that the file has until then, when it is written to its end; if it raises, what was
            there before stays.

    Raises:
        StorageError: as :func:`write_whole`.
    """
    with _told(path, ""), replacing(path) as file:
        yield file
        if check is not None:
            file.flush()
            check(partial_path(path.resolve() if path.is_symlink() else path))


@contextmanager
def replacing(path: Path, *, partial: Path | None = None, sync: bool = True) -> Iterator[BinaryIO]:
    """As :func:`whole_file`, for who has a sentence of its own for what the system refuses.

    Args:
        path: the file.
        partial: its name while it is written; None for that of :func:`partial_path`.
        sync: whether it is on the disk after the block.

    Raises:
        OSError: it cannot be written; what was there before stays.
        StorageError: another process writes it.
    """
    if path.exists() and not path.is_file() and not path.is_dir():
        with path.open("wb") as file:  # a pipe or a device, such as /dev/stdout, which must not become a file
            yield file
        return
    path = path.resolve() if path.is_symlink() else path  # The link stays.
    partial = partial or partial_path(path)
    file = open_alone(partial, of=path)
    try:
        file.truncate()  # what a killed process has left
        yield file
        file.flush()
        if sync:
            os.fsync(file.fileno())
        partial.replace(path)
    except BaseException:
        with suppress(OSError):
            partial.unlink()
        with suppress(OSError):  # A file that has met a full disk tells it again.
            file.close()
        raise
    file.close()
    if sync:
        sync_folder(path.parent)


def open_alone(partial: Path, *, of: Path, buffering: int = -1) -> BinaryIO:
    """The file ``partial``, with what is in it, at its beginning, open for writing by this process alone.

    Args:
        partial: made if it is not there.
        of: the file that it becomes, for the message.
        buffering: as of :func:`open`.

    Raises:
        OSError: it cannot be opened.
        StorageError: another process writes it.
    """
    while True:
        file = open_lockable(partial, buffering=buffering)
        if not lock_file(file):
            file.close()
            raise StorageError(f"Another process writes {of}; wait for its end, or choose another name.")
        if _is_at(file, partial):
            return file
        file.close()  # Who had the lock has renamed or removed it since it was opened here: that is not ours to change.


def give_name(partial: Path, path: Path) -> None:
    """Syncs the file ``partial`` that is written to its end, renames it, and syncs the folder (Note [Whole files]).

    Raises:
        OSError: one of these has failed.
    """
    _sync(partial)
    partial.replace(path)
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Makes names that were given in a folder durable, where the file system can.

    Raises:
        OSError: the disk has failed.
    """
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
def _told(path: Path, called: str) -> Iterator[None]:
    """What the system refuses in the block as one sentence."""
    try:
        yield
    except OSError as error:
        reason = f"{path.parent} is a file" if os.path.isfile(path.parent) else error.strerror or str(error)
        name = f"{called} {path}".lstrip()
        raise StorageError(f"{name} cannot be written ({reason}){_ADVICE.get(error.errno or 0, '')}.") from error

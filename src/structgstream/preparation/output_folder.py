# SPDX-License-Identifier: Apache-2.0
"""The folder of a capture: whose it is, who writes to it, and how what was filmed gets into it.

A folder of other videos, one made by hand, or one that another process prepares is not written into. Files are linked
where that is possible, so that nothing is stored twice.
"""

import json
import os
import shutil
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from structgstream.atomic_files import give_name, lock_file, open_lockable, partial_path, replacing
from structgstream.errors import CaptureError, StorageError
from structgstream.preparation.options import Link
from structgstream.preparation.steps import FOLDER

SOURCE = "source.json"
LOCK = ".preparing"
_MARKS = (Path(FOLDER), partial_path(Path(FOLDER, SOURCE)))
"""What a mark that was interrupted or met a full disk leaves in a folder, which is as free as before."""


def mark_output(capture: Path, videos: Path) -> None:
    """Marks ``capture`` as the one of these videos; a ``CaptureError`` where it is something else's folder."""
    marker = capture / FOLDER / SOURCE
    origin = str(videos.resolve())
    if capture.resolve() == videos.resolve():
        raise CaptureError(f"The capture cannot be the folder of the videos itself, {videos}; choose another with -o.")
    if capture.exists() and not capture.is_dir():
        raise CaptureError(f"{capture} is a file; choose a folder with -o.")
    if marker.is_file():
        before = None
        with suppress(OSError, ValueError, KeyError, TypeError):
            before = str(json.loads(marker.read_text())["videos"])
        if before != origin:
            raise CaptureError(
                f"{capture} was prepared from {before}, not from {origin}; choose another folder with -o, or remove it."
            )
        return
    if any(entry.relative_to(capture) not in _MARKS for entry in capture.rglob("*")):
        raise CaptureError(f"The folder {capture} is not empty and was not made by prepare; choose another with -o.")
    try:
        marker.parent.mkdir(parents=True, exist_ok=True)
        with replacing(marker) as file:
            file.write(f"{json.dumps({'videos': origin})}\n".encode())
    except OSError as error:
        raise StorageError(f"The folder {capture} cannot be written ({error.strerror}).") from None


@contextmanager
def lock_output(capture: Path) -> Iterator[None]:
    """No other process prepares the same marked capture within the block, or a ``StorageError`` says that one does."""
    try:
        file = open_lockable(capture / FOLDER / LOCK)
    except OSError as error:
        raise StorageError(f"The folder {capture} cannot be written ({error.strerror}).") from None
    with file:
        if not lock_file(file):
            raise StorageError(
                f"Another process prepares {capture} now; wait for its end, or choose another folder with -o."
            )
        yield


def link(source: Path, target: Path, *, how: Link) -> None:
    """Makes ``target`` the file or the folder of files ``source``; what is there already stays.

    ``how`` is ``hard`` links, and copies where file systems differ; ``symlink`` to the source; or ``copy``.
    """
    try:
        if source.is_dir():
            target.mkdir(parents=True, exist_ok=True)
            for file in sorted(entry for entry in source.iterdir() if entry.is_file()):
                _link_file(file, target / file.name, how)
        else:
            target.parent.mkdir(parents=True, exist_ok=True)
            _link_file(source, target, how)
    except OSError as error:
        raise StorageError(
            f"{source} cannot be linked or copied to {target} ({error.strerror}); make room, or use --link symlink."
        ) from None


def remove_others(folder: Path, names: Collection[str]) -> None:
    """Removes files that an earlier run linked into ``folder`` and whose names are not among ``names``."""
    for file in sorted(entry for entry in folder.iterdir() if entry.name not in names and not entry.is_dir()):
        _remove(file)


def unlink(source: Path, target: Path) -> None:
    """Removes what :func:`link` made of ``source``, a file or a folder of files; other files stay."""
    if source.is_dir():
        for file in sorted(entry for entry in source.iterdir() if entry.is_file()):
            unlink(file, target / file.name)
        if target.is_dir() and not any(target.iterdir()):
            target.rmdir()
    elif target.is_file() and any(_same(source, target, how) for how in ("hard", "symlink", "copy")):
        _remove(target)


def _remove(file: Path) -> None:
    try:
        file.unlink()
    except OSError as error:
        raise StorageError(
            f"{file} belongs to no camera now and cannot be removed ({error.strerror}); remove it."
        ) from None


def _link_file(source: Path, target: Path, how: Link) -> None:
    if _same(source, target, how):
        return
    target.unlink(missing_ok=True)
    source = source.resolve()
    if how == "symlink":
        target.symlink_to(source)
        return
    if how == "hard":
        try:
            os.link(source, target)
            return
        except OSError:  # another file system, or one without links
            pass
    part = partial_path(target)
    try:
        shutil.copy2(source, part)
        give_name(part, target)
    except BaseException:  # a full disk is full of it
        part.unlink(missing_ok=True)
        raise


def _same(source: Path, target: Path, how: Link) -> bool:
    """Whether the target was made by an earlier run."""
    if not target.exists():
        return False
    if how == "symlink" or target.is_symlink():
        return how == "symlink" and target.is_symlink() and target.resolve() == source.resolve()
    if target.samefile(source):
        return how != "copy"
    one, other = source.stat(), target.stat()
    return (one.st_size, one.st_mtime_ns) == (other.st_size, other.st_mtime_ns)

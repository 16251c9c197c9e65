# SPDX-License-Identifier: Apache-2.0
"""Brings what was filmed into a capture, without storing it twice where that is possible."""

import os
import shutil
from collections.abc import Collection
from pathlib import Path
from typing import Literal

from structgstream.atomic_files import give_name, partial_path
from structgstream.errors import StorageError

Link = Literal["hard", "symlink", "copy"]


def bring(source: Path, target: Path, *, link: Link) -> None:
    """Makes ``target`` the file or the folder of files ``source``; what is there already stays.

    Args:
        source: a file, or a folder of files.
        target: its place in the capture.
        link: ``hard`` links, and copies where file systems differ; ``symlink`` points to the source; ``copy`` copies.

    Raises:
        StorageError: it cannot be written.
    """
    try:
        if source.is_dir():
            target.mkdir(parents=True, exist_ok=True)
            for file in sorted(entry for entry in source.iterdir() if entry.is_file()):
                _bring_file(file, target / file.name, link)
        else:
            target.parent.mkdir(parents=True, exist_ok=True)
            _bring_file(source, target, link)
    except OSError as error:
        raise StorageError(
            f"{source} cannot be brought to {target} ({error.strerror}); make room, or use --link symlink."
        ) from None


def drop_others(folder: Path, kept: Collection[str]) -> None:
    """Removes what an earlier run has brought to ``folder`` and is no more among the files of the names ``kept``.

    Raises:
        StorageError: it cannot be removed.
    """
    for file in sorted(entry for entry in folder.iterdir() if entry.name not in kept and not entry.is_dir()):
        _remove(file)


def unbring(source: Path, target: Path) -> None:
    """Removes what :func:`bring` has made of ``source``, a file or a folder of files; what is another's stays.

    Raises:
        StorageError: it cannot be removed.
    """
    if source.is_dir():
        for file in sorted(entry for entry in source.iterdir() if entry.is_file()):
            unbring(file, target / file.name)
        if target.is_dir() and not any(target.iterdir()):
            target.rmdir()
    elif target.is_file() and any(_same(source, target, link) for link in ("hard", "symlink", "copy")):
        _remove(target)


def _remove(file: Path) -> None:
    try:
        file.unlink()
    except OSError as error:
        raise StorageError(f"{file} is of no camera now and cannot be removed ({error.strerror}); remove it.") from None


def _bring_file(source: Path, target: Path, link: Link) -> None:
    if _same(source, target, link):
        return
    target.unlink(missing_ok=True)
    source = source.resolve()
    if link == "symlink":
        target.symlink_to(source)
        return
    if link == "hard":
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


def _same(source: Path, target: Path, link: Link) -> bool:
    """Whether the target is that of an earlier run."""
    if not target.exists():
        return False
    if link == "symlink" or target.is_symlink():
        return link == "symlink" and target.is_symlink() and target.resolve() == source.resolve()
    if target.samefile(source):
        return link != "copy"
    one, other = source.stat(), target.stat()
    return (one.st_size, one.st_mtime_ns) == (other.st_size, other.st_mtime_ns)

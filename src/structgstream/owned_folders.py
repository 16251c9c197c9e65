# SPDX-License-Identifier: Apache-2.0
"""Folders that the program may delete: each has a marker file, and only files with names of the program are removed.

Note [Ownership]
~~~~~~~~~~~~~~~~
A folder is used for side files if it is missing, empty, or has a marker of the same purpose; any other folder is
refused before anything in it changes. The marker's identity is random and equal only in folders of the same run, for
example a local one and one in an object store. Files are removed by name, so files of a user in a marked folder are not
removed.
"""

import json
import re
import uuid
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from structgstream.atomic_files import atomic_write, partial_path
from structgstream.errors import StorageError

MARKER = "structgstream-owner.json"
"""Name of the marker file."""


@dataclass(frozen=True)
class Owner:
    """The content of a marker."""

    purpose: str  # purpose of the folder, in a few words for messages, such as "parts of a parallel run"
    identity: str  # random, equal in all folders of one run
    key: str = ""  # hash of the run's inputs; empty if it does not matter

    @staticmethod
    def new(purpose: str) -> "Owner":
        """An owner with a new random identity."""
        return Owner(purpose, uuid.uuid4().hex)

    @property
    def content(self) -> bytes:
        """The content of the marker file."""
        return f"{json.dumps({'made_by': 'structgstream', **asdict(self)}, indent=1)}\n".encode()


def parse_owner(content: bytes) -> Owner | None:
    """The owner in the content of a marker file; None if it is another file."""
    try:
        found = json.loads(content)
        if found["made_by"] != "structgstream":
            return None
        values = (found["purpose"], found["identity"], found["key"])
    except (ValueError, KeyError, TypeError, RecursionError):
        return None
    return Owner(*values) if all(isinstance(value, str) for value in values) else None


def owner_of(folder: Path) -> Owner | None:
    """The owner of a folder; None without a marker."""
    path = folder / MARKER
    try:
        return parse_owner(path.read_bytes()) if path.is_file() and not path.is_symlink() else None
    except OSError:
        return None


def check_owned(folder: Path, purpose: str) -> Owner | None:
    """The owner of a folder that may be used for ``purpose``; None if it is missing or empty. Raises StorageError if it
    is a file, cannot be read, or contains files without a marker of this purpose."""
    found = owner_of(folder)
    if found is not None and found.purpose == purpose:
        return found
    try:
        other = {path.name for path in folder.iterdir()} - {partial_path(folder / MARKER).name}
    except FileNotFoundError:
        return None
    except OSError as error:
        raise StorageError(f"The folder {folder} cannot be used for the {purpose} ({error.strerror}).") from None
    if not other:
        return None
    what = "no marker" if found is None else f"a marker for the {found.purpose}"
    raise StorageError(
        f"{folder} is needed for the {purpose}, and contains files with {what} of structgstream ({MARKER}), so it may "
        "be somebody else's; nothing in it was changed. Choose another output, or move the folder to another place."
    )


def own_folder(folder: Path, purpose: str, *, owner: Owner | None = None) -> Owner:
    """Creates and marks a folder unless it is marked already; returns its owner, by default with a random identity.
    Raises StorageError as :func:`check_owned`, or if it cannot be created."""
    found = check_owned(folder, purpose)
    if found is None:
        found = Owner.new(purpose) if owner is None else owner
        atomic_write(folder / MARKER, found.content, called=f"The folder for the {purpose}:", new_folder=True)
    return found


def remove_own(
    folder: Path, purpose: str, names: re.Pattern[str], *, order: Mapping[str, int] | None = None, whole: bool = False
) -> None:
    """Removes the files of a marked folder whose relative path matches ``names``, and folders that are empty then.

    Args:
        names: pattern of relative paths with slashes, matched in full.
        order: priority by path: smaller ones are removed first; the default is 1.
        whole: also remove the marker and the folder if nothing else remains.

    Raises:
        StorageError: the folder has no marker of this purpose, or a file cannot be removed.
    """
    if check_owned(folder, purpose) is None:
        return
    try:
        inside = sorted(folder.rglob("*"), key=lambda path: ((order or {}).get(path.name, 1), str(path)))
        emptied = set[Path]()
        for path in inside:
            is_file = path.is_symlink() or not path.is_dir()
            if is_file and names.fullmatch(path.relative_to(folder).as_posix()):
                path.unlink()
                emptied.add(path.parent)
        for path in sorted(emptied - {folder}, reverse=True):
            if not any(path.iterdir()):
                path.rmdir()
        if whole and {path.name for path in folder.iterdir()} <= {MARKER}:
            (folder / MARKER).unlink()
            folder.rmdir()
    except OSError as error:
        raise StorageError(f"{error.filename or folder} cannot be removed ({error.strerror}).") from error

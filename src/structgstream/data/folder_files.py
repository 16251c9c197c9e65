# SPDX-License-Identifier: Apache-2.0
"""The files of a folder by kind, as all readers of folders look for them."""

from collections.abc import Collection, Iterable
from pathlib import Path
from unicodedata import normalize

from structgstream.errors import CaptureError

REPORT = "report"
"""The folder that the check of a capture leaves in it, whose pictures are no camera's."""


SYSTEM = frozenset({"__MACOSX", "@eaDir", "#recycle", "$RECYCLE.BIN", "System Volume Information", "lost+found"})
"""Folders that file servers, archives and systems leave, with pictures of their own."""


def is_hidden(path: Path) -> bool:
    """Whether a file is none that was filmed: macOS leaves a ``._NAME`` beside each NAME on file systems of cards."""
    return path.name.startswith(".") or path.name in SYSTEM


def name_of(path: Path) -> str:
    """The name of a folder, or of a file without its suffix, as a camera's: letters with marks composed, as in texts.

    File systems of macOS take them apart.
    """
    return normalize("NFC", path.name if path.is_dir() else path.stem)


def files_of(folder: Path, suffixes: Collection[str]) -> list[Path]:
    """The files of these kinds (lower-case suffixes, with the dot) in a folder, sorted by name, without hidden ones.

    Raises:
        CaptureError: one is a link to a file that is not there.
    """
    named = (file for file in folder.iterdir() if file.suffix.lower() in suffixes and not is_hidden(file))
    found = sorted(file for file in named if not file.is_dir())
    for file in found:
        check_link(file)
    return found


def check_link(file: Path) -> None:
    """A link leads somewhere.

    Raises:
        CaptureError: it does not.
    """
    if file.is_symlink() and not file.exists():
        raise CaptureError(
            f"{file} is a link to {file.readlink()}, which does not exist; restore that file, or move the link out of "
            "the folder."
        )


def by_stem(files: Iterable[Path]) -> dict[str, Path]:
    """Files by their names without suffix.

    Raises:
        CaptureError: two have one name.
    """
    found: dict[str, Path] = {}
    for file in files:
        if (name := name_of(file)) in found:
            raise CaptureError(
                f"{found[name].name} and {file.name} in {file.parent} are of one name, {name!r}; expected one file of "
                "each: move the other out of the folder."
            )
        found[name] = file
    return found

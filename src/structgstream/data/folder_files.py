# SPDX-License-Identifier: Apache-2.0
"""The files of a folder by kind, as all readers of folders look for them."""

from collections.abc import Collection, Iterable
from pathlib import Path

from structgstream.errors import CaptureError

REPORT = "report"
"""The folder that the check of a capture leaves in it, whose pictures are no camera's."""


def is_hidden(path: Path) -> bool:
    """Whether a file is none that was filmed: macOS leaves a ``._NAME`` beside each NAME on file systems of cards."""
    return path.name.startswith(".")


def files_of(folder: Path, suffixes: Collection[str]) -> list[Path]:
    """The files of these kinds (lower-case suffixes, with the dot) in a folder, sorted by name, without hidden ones.

    Raises:
        CaptureError: one is a link to a file that is not there.
    """
    found = sorted(file for file in folder.iterdir() if file.suffix.lower() in suffixes and not is_hidden(file))
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
        if file.stem in found:
            raise CaptureError(
                f"{found[file.stem].name} and {file.name} in {file.parent} are of one name, {file.stem!r}; expected "
                "one file of each: move the other out of the folder."
            )
        found[file.stem] = file
    return found

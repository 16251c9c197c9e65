# SPDX-License-Identifier: Apache-2.0
"""The text file next to a track that lists its groups: one ``a:b`` per line, from frame a to before frame b."""

from collections.abc import Sequence
from pathlib import Path

from structgstream.atomic_files import atomic_write
from structgstream.errors import StreamError

Groups = Sequence[tuple[int, int]]
"""First frame and end of each group, in order."""


def groups_path(track: Path) -> Path:
    """The path of a track's list."""
    return track.with_name(f"{track.name}.groups")


def write_groups(track: Path, groups: Groups) -> None:
    """Writes the list of a track atomically.

    Raises:
        StorageError: it cannot be written.
    """
    atomic_write(groups_path(track), "".join(f"{first}:{end}\n" for first, end in groups).encode())


def read_groups(track: Path) -> Groups | None:
    """The groups of a track of a whole capture; None while the pass has not chosen them.

    Raises:
        StreamError: the list has gaps or does not follow the format.
    """
    path = groups_path(track)
    try:
        text = path.read_text(errors="replace")
    except OSError:
        return None
    if not text.endswith("\n"):
        return None
    try:
        groups = [(int(first), int(end)) for first, _, end in (line.partition(":") for line in text.split())]
    except ValueError:
        raise StreamError(f"{path} has no groups, 'first:end' a line.") from None
    borders = [0, *(end for _, end in groups)]
    if not groups or [first for first, _ in groups] != borders[:-1] or borders != sorted(set(borders)):
        raise StreamError(f"The groups in {path} do not follow each other from frame 0 on.")
    return groups

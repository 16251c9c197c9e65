# SPDX-License-Identifier: Apache-2.0
"""The list of the qualities of one stream, from which players choose (docs/player.md, Qualities)."""

import json
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from structgstream.atomic_files import atomic_write
from structgstream.codec.segments.manifest import MANIFEST, Fields, parse_document
from structgstream.codec.segments.store import read_bounded
from structgstream.errors import StreamError

QUALITIES = "qualities.json"
"""The name of the list."""
FORMAT = "structgstream-qualities"
VERSION = 1
MAX_QUALITIES = 8
MAX_LIST_BYTES = 64 * 1024

_NAME = re.compile(r"[A-Za-z0-9_-]{1,64}", re.ASCII)
_PATH = re.compile(r"([A-Za-z0-9_-][A-Za-z0-9._-]{0,127}/){0,4}[A-Za-z0-9_-][A-Za-z0-9._-]{0,127}", re.ASCII)


@dataclass(frozen=True)
class ListedQuality:
    """One of the runs of the same frames."""

    name: str  # what players call it
    manifest: str  # path of its manifest below the list
    bits_per_second: float  # of media time, as measured, or expected while nothing has been measured

    @property
    def folder(self) -> str | None:
        """The folder of segments in the list's folder; None if its manifest lies elsewhere."""
        folder, _, file = self.manifest.rpartition("/")
        return folder if file == MANIFEST and folder and "/" not in folder else None


def is_quality_name(name: str) -> bool:
    """Whether a quality of this name can have a folder of segments and a log: a dot would begin a suffix."""
    return _NAME.fullmatch(name) is not None


def list_to_json(qualities: Sequence[ListedQuality]) -> bytes:
    """The content of ``qualities.json``."""
    values = {"format": FORMAT, "version": VERSION, "qualities": [asdict(one) for one in qualities]}
    return f"{json.dumps(values, allow_nan=False)}\n".encode()


def list_from_json(data: bytes, *, name: str) -> tuple[ListedQuality, ...]:
    """The qualities in ``data``; ``name`` is for messages. Raises StreamError if it is no list of qualities, of a newer
    version, or leaves the bounds of players."""
    what = "list of qualities"
    top = parse_document(data, name, max_bytes=MAX_LIST_BYTES, what=what, format=FORMAT, version=VERSION)
    qualities = tuple(_quality(entry) for entry in top.items("qualities", most=MAX_QUALITIES))
    if not qualities:
        raise StreamError(f"{name} lists no quality.")
    return qualities


def read_list(folder: Path) -> tuple[ListedQuality, ...] | None:
    """The qualities of a folder; None if it has no list. Raises StreamError if the list is none, or cannot be read."""
    path = folder / QUALITIES
    if not path.exists():
        return None
    data = read_bounded(path, max_bytes=MAX_LIST_BYTES)
    return list_from_json(data, name=str(path))


def write_list(folder: Path, qualities: Sequence[ListedQuality]) -> None:
    """Writes the list of a folder, or replaces it in one step. Raises StorageError if it cannot be written; what was
    there before stays."""
    atomic_write(folder / QUALITIES, list_to_json(qualities), called="The list of qualities")


def _quality(entry: Fields) -> ListedQuality:
    manifest = entry.text("manifest")
    if not _PATH.fullmatch(manifest):
        entry.refuse(f"has the manifest {manifest!r}; expected the plain path of a manifest below the list")
    return ListedQuality(entry.text("name"), manifest, entry.number("bits_per_second", least=1.0))

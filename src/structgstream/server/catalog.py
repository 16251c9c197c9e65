# SPDX-License-Identifier: Apache-2.0
"""Which streams a folder holds."""

import os
import stat
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from itertools import islice
from pathlib import Path
from typing import Final

from structgstream.codec.segments.quality_list import MOST_LIST_BYTES, QUALITIES, list_from_json
from structgstream.errors import PlayerError, StreamError
from structgstream.server.files import OpenedFile, open_below
from structgstream.server.names import MANIFEST, STREAM_SUFFIX, is_stream_name
from structgstream.whole_files import side_path

LOOK_AGAIN_SECONDS: Final = 1.0
MOST_ENTRIES: Final = 10_000


class StreamKind(Enum):
    """How a stream is stored."""

    SEGMENTS = "segments"
    QUALITIES = "qualities"
    FILE = "file"

    @property
    def source(self) -> str:
        """Which of its addresses a player is given."""
        return {"segments": MANIFEST, "qualities": QUALITIES, "file": "stream.sgs"}[self.value]


@dataclass(frozen=True)
class ServedStream:
    """A stream in the folder ``root``.

    Args:
        root: the folder.
        name: a folder of segments, a folder of several qualities of one stream, or a file, with its suffix; one of the
            qualities has the folder's name, a slash, and its own.
        kind: which of them.
        qualities: folders of segments in the folder of several, the one with the lowest bit rate first.
    """

    root: Path
    name: str
    kind: StreamKind
    qualities: tuple[str, ...] = ()

    @property
    def made_of(self) -> tuple["ServedStream", ...]:
        """The streams of segments: itself, or its qualities, or none."""
        if self.kind is StreamKind.SEGMENTS:
            return (self,)
        return tuple(ServedStream(self.root, f"{self.name}/{one}", StreamKind.SEGMENTS) for one in self.qualities)

    def open(self, file: str) -> OpenedFile | None:
        """A file of its folder; None if there is none. Blocks.

        Raises:
            OSError: the system cannot open files now.
        """
        return open_below(self.root, *self.name.split("/"), file)

    def open_whole(self) -> OpenedFile | None:
        """The stream's only file; None if it is gone. Blocks.

        Raises:
            OSError: the system cannot open files now.
        """
        return open_below(self.root, self.name)

    def open_beside(self, suffix: str) -> OpenedFile | None:
        """The file beside the stream that is named after it, with this ending; None without one. Blocks.

        Raises:
            OSError: the system cannot open files now.
        """
        *folders, own = self.name.split("/")
        return open_below(self.root, *folders, side_path(Path(own), suffix).name)


class Catalog:
    """The streams of a folder, looked for again when the last look is a second old. Thread-safe.

    A folder that is itself one of segments, or of several qualities, holds one stream: itself.

    Args:
        folder: the folder.
        clock: seconds that rise.

    Raises:
        PlayerError: it is no folder, or cannot be read.
    """

    def __init__(self, folder: Path, *, clock: Callable[[], float] = time.monotonic) -> None:
        if folder.is_file():
            raise PlayerError(f"{folder} is a file; serve takes a folder of streams: {folder.resolve().parent}.")
        self._folder = folder.resolve()
        self._clock = clock
        self._lock = threading.Lock()
        self._looked_at = -float("inf")
        self.found: Mapping[str, ServedStream] = {}
        """The streams by their names, sorted, at the last look."""
        self.unnamed: tuple[str, ...] = ()
        """Names of streams that are not served because of characters in their names."""
        try:
            self._look()
        except OSError as error:
            raise PlayerError(f"The folder {folder} cannot be read ({error.strerror}).") from None

    @property
    def stale(self) -> bool:
        """Whether it is time to look again."""
        return self._clock() - self._looked_at >= LOOK_AGAIN_SECONDS

    def look(self) -> None:
        """Looks for streams if it is time. Blocks.

        Raises:
            OSError: the folder cannot be read.
        """
        with self._lock:
            if self.stale:
                self._look()

    def _look(self) -> None:
        itself = _in_folder(self._folder.parent, self._folder.name) if self._folder.name else None
        if itself is not None:
            found = {itself.name: itself}
        else:
            with os.scandir(self._folder) as entries:
                streams = [_stream(self._folder, entry) for entry in islice(entries, MOST_ENTRIES)]
            found = {one.name: one for one in sorted(filter(None, streams), key=lambda one: one.name)}
        self.found = {name: stream for name, stream in found.items() if is_stream_name(name)}
        self.unnamed = tuple(name for name in found if not is_stream_name(name))
        self._looked_at = self._clock()


def _stream(root: Path, entry: "os.DirEntry[str]") -> ServedStream | None:
    """What an entry of the folder is; None for what is no stream, links included (Note [No links])."""
    if entry.name.startswith("."):
        return None
    if entry.is_file(follow_symlinks=False):
        return ServedStream(root, entry.name, StreamKind.FILE) if entry.name.endswith(STREAM_SUFFIX) else None
    return _in_folder(root, entry.name) if entry.is_dir(follow_symlinks=False) else None


def _in_folder(root: Path, name: str) -> ServedStream | None:
    """The stream that is the folder ``name``: of segments, or of several qualities as soon as all have a manifest."""
    if _has_manifest(root / name):
        return ServedStream(root, name, StreamKind.SEGMENTS)
    try:
        folders = _qualities(root, name)
        whole = all(one and is_stream_name(one) and _opens(root, name, one, MANIFEST) for one in folders)
    except (OSError, StreamError):
        return None
    return ServedStream(root, name, StreamKind.QUALITIES, tuple(filter(None, folders))) if folders and whole else None


def _qualities(root: Path, name: str) -> list[str | None]:
    """The folders beside the list of a folder, by rising bit rate: None for what is elsewhere; empty without a list."""
    opened = open_below(root, name, QUALITIES)
    if opened is None:
        return []
    with opened:
        listed = list_from_json(opened.read(0, min(len(opened), MOST_LIST_BYTES + 1)), name=name)
    return [one.folder for one in sorted(listed, key=lambda one: one.bits_per_second)]


def _opens(root: Path, *parts: str) -> bool:
    opened = open_below(root, *parts)
    if opened is not None:
        opened.close()
    return opened is not None


def _has_manifest(folder: Path) -> bool:
    try:
        return stat.S_ISREG((folder / MANIFEST).lstat().st_mode)
    except OSError:
        return False

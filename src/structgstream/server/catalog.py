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

from structgstream.errors import PlayerError
from structgstream.server.files import OpenedFile, open_below
from structgstream.server.names import MANIFEST, STREAM_SUFFIX, is_stream_name

LOOK_AGAIN_SECONDS: Final = 1.0
MOST_ENTRIES: Final = 10_000


class StreamKind(Enum):
    """How a stream is stored."""

    SEGMENTS = "segments"
    FILE = "file"


@dataclass(frozen=True)
class ServedStream:
    """A stream in the folder ``root``: the folder of segments ``name``, or the file ``name``, with its suffix."""

    root: Path
    name: str
    kind: StreamKind

    def open(self, file: str) -> OpenedFile | None:
        """A file of its segments folder; None if there is none. Blocks.

        Raises:
            OSError: the system cannot open files now.
        """
        return open_below(self.root, self.name, file)

    def open_whole(self) -> OpenedFile | None:
        """The stream's only file; None if it is gone. Blocks.

        Raises:
            OSError: the system cannot open files now.
        """
        return open_below(self.root, self.name)

    def open_beside(self, suffix: str) -> OpenedFile | None:
        """The file beside the stream that is named after it, with another suffix; None without one. Blocks.

        Raises:
            OSError: the system cannot open files now.
        """
        return open_below(self.root, Path(self.name).with_suffix(suffix).name)


class Catalog:
    """The streams of a folder, looked for again when the last look is a second old. Thread-safe.

    A folder that is itself a segments folder holds one stream: itself.

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
        if _has_manifest(self._folder):
            found = {self._folder.name: ServedStream(self._folder.parent, self._folder.name, StreamKind.SEGMENTS)}
        else:
            with os.scandir(self._folder) as entries:
                kinds = {entry.name: kind for entry in islice(entries, MOST_ENTRIES) if (kind := _kind(entry))}
            found = {name: ServedStream(self._folder, name, kinds[name]) for name in sorted(kinds)}
        self.found = {name: stream for name, stream in found.items() if is_stream_name(name)}
        self.unnamed = tuple(name for name in found if not is_stream_name(name))
        self._looked_at = self._clock()


def _kind(entry: "os.DirEntry[str]") -> StreamKind | None:
    """What an entry of the folder is; None for what is no stream, links included (Note [No links])."""
    if entry.name.startswith("."):
        return None
    if entry.is_file(follow_symlinks=False):
        return StreamKind.FILE if entry.name.endswith(STREAM_SUFFIX) else None
    if entry.is_dir(follow_symlinks=False) and _has_manifest(Path(entry.path)):
        return StreamKind.SEGMENTS
    return None


def _has_manifest(folder: Path) -> bool:
    try:
        return stat.S_ISREG((folder / MANIFEST).lstat().st_mode)
    except OSError:
        return False

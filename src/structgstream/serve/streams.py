# SPDX-License-Identifier: Apache-2.0
"""The streams of a folder."""

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

from structgstream.atomic_files import side_path
from structgstream.codec.segments.manifest import MANIFEST
from structgstream.codec.segments.quality_list import MAX_LIST_BYTES, QUALITIES, list_from_json
from structgstream.errors import PlayerError, StreamError
from structgstream.serve.files import STREAM_SUFFIX, OpenedFile, is_stream_name, open_below

REFRESH_SECONDS: Final = 1.0
MAX_ENTRIES: Final = 10_000


class StreamKind(Enum):
    """How a stream is stored."""

    SEGMENTS = "segments"
    QUALITIES = "qualities"
    FILE = "file"

    @property
    def source(self) -> str:
        """The address that the player opens, relative to the stream's page."""
        return {"segments": MANIFEST, "qualities": QUALITIES, "file": "stream.sgs"}[self.value]


@dataclass(frozen=True)
class ServedStream:
    """A stream in the folder ``root``.

    Args:
        root: the folder.
        name: of the folder of segments, of the folder of renditions (qualities), or of the file with its suffix; a
            rendition is named FOLDER/RENDITION.
        kind: how it is stored.
        renditions: folders of segments in the folder of renditions, by rising bit rate.
    """

    root: Path
    name: str
    kind: StreamKind
    renditions: tuple[str, ...] = ()

    @property
    def segments(self) -> tuple["ServedStream", ...]:
        """The streams of segments: itself, its renditions, or none."""
        if self.kind is StreamKind.SEGMENTS:
            return (self,)
        return tuple(ServedStream(self.root, f"{self.name}/{one}", StreamKind.SEGMENTS) for one in self.renditions)

    def open(self, file: str) -> OpenedFile | None:
        """A file of its folder; None if there is none. Blocks.

        Raises:
            OSError: the system cannot open files now.
        """
        return open_below(self.root, *self.name.split("/"), file)

    def open_whole(self) -> OpenedFile | None:
        """The file of a stream that is one file; None if it has been removed. Blocks.

        Raises:
            OSError: the system cannot open files now.
        """
        return open_below(self.root, self.name)

    def open_beside(self, suffix: str) -> OpenedFile | None:
        """The side file of the stream with this suffix; None if there is none. Blocks.

        Raises:
            OSError: the system cannot open files now.
        """
        *folders, own = self.name.split("/")
        return open_below(self.root, *folders, side_path(Path(own), suffix).name)


class Catalog:
    """The streams of a folder, listed again when the last listing is a second old.

    A folder of segments, or of renditions, is one stream: itself.

    Args:
        folder: the folder.
        clock: monotonic seconds.

    Raises:
        PlayerError: it is no folder, or cannot be read.
    """

    def __init__(self, folder: Path, *, clock: Callable[[], float] = time.monotonic) -> None:
        if folder.is_file():
            raise PlayerError(f"{folder} is a file; serve takes a folder of streams: {folder.resolve().parent}.")
        self._folder = folder.resolve()
        self._clock = clock
        self._lock = threading.Lock()
        self._listed_at = -float("inf")
        self._found: Mapping[str, ServedStream] = {}
        try:
            self.found()
        except OSError as error:
            raise PlayerError(f"The folder {folder} cannot be read ({error.strerror}).") from None

    def found(self) -> Mapping[str, ServedStream]:
        """The streams by their names, sorted. Blocks; thread-safe.

        Raises:
            OSError: the folder cannot be read.
        """
        with self._lock:
            if self._clock() - self._listed_at >= REFRESH_SECONDS:
                self._found = self._list()
                self._listed_at = self._clock()
            return self._found

    def _list(self) -> Mapping[str, ServedStream]:
        itself = _in_folder(self._folder.parent, self._folder.name) if self._folder.name else None
        if itself is not None:
            found = [itself]
        else:
            with os.scandir(self._folder) as entries:
                streams = [_stream(self._folder, entry) for entry in islice(entries, MAX_ENTRIES)]
            found = sorted(filter(None, streams), key=lambda one: one.name)
        return {one.name: one for one in found if is_stream_name(one.name)}


def _stream(root: Path, entry: "os.DirEntry[str]") -> ServedStream | None:
    """The stream that is an entry of the folder; None for other entries and links (Note [No links])."""
    if entry.name.startswith("."):
        return None
    if entry.is_file(follow_symlinks=False):
        return ServedStream(root, entry.name, StreamKind.FILE) if entry.name.endswith(STREAM_SUFFIX) else None
    return _in_folder(root, entry.name) if entry.is_dir(follow_symlinks=False) else None


def _in_folder(root: Path, name: str) -> ServedStream | None:
    """The stream that is the folder ``name``: of segments, or of renditions as soon as all have a manifest."""
    if _has_manifest(root / name):
        return ServedStream(root, name, StreamKind.SEGMENTS)
    try:
        folders = _renditions(root, name)
        whole = all(one and is_stream_name(one) and _opens(root, name, one, MANIFEST) for one in folders)
    except (OSError, StreamError):
        return None
    return ServedStream(root, name, StreamKind.QUALITIES, tuple(filter(None, folders))) if folders and whole else None


def _renditions(root: Path, name: str) -> list[str | None]:
    """The folders of the list of renditions, by rising bit rate: None for one elsewhere; empty without a list."""
    opened = open_below(root, name, QUALITIES)
    if opened is None:
        return []
    with opened:
        listed = list_from_json(opened.read(0, min(len(opened), MAX_LIST_BYTES + 1)), name=name)
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

# SPDX-License-Identifier: Apache-2.0
"""The streams of a folder: their names, and opening of their files, never of one outside the folder.

Note [Plain names]
~~~~~~~~~~~~~~~~~~
Names of streams and their files consist of letters, digits, dots, dashes and underscores. So every address has a single
spelling, without percent signs, and no address leads out of a folder.

Note [No links]
~~~~~~~~~~~~~~~
Each part of a path is opened relative to the folder before it, and none may be a symbolic link. So a folder cannot be
replaced by a link between check and opening. Only regular files are opened; opening a pipe does not wait for its
writer.
"""

import errno
import logging
import os
import re
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
from structgstream.codec.container.byte_source import FileBytes
from structgstream.codec.segments.manifest import MANIFEST
from structgstream.codec.segments.quality_list import MAX_LIST_BYTES, QUALITIES, list_from_json
from structgstream.codec.segments.store import is_ours
from structgstream.errors import PlayerError, StreamError

log = logging.getLogger(__name__)

STREAM_SUFFIX: Final = ".sgs"
PLAIN: Final = "names of streams are up to 128 of A-Z a-z 0-9 . - _, without a dot first"

_STREAM = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9._-]{0,127}", re.ASCII)
_PATH = re.compile(rb"/[A-Za-z0-9._/-]*")
_MISSING = {errno.ENOENT, errno.ENOTDIR, errno.ELOOP, errno.EACCES, errno.ENXIO, errno.ENAMETOOLONG, errno.EISDIR}
_SAFELY = os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK


def is_stream_name(name: str) -> bool:
    """Whether a stream of this name can be served (Note [Plain names])."""
    return _STREAM.fullmatch(name) is not None


def hash_in_name(file: str) -> str | None:
    """The 16 hex digits in the name of an immutable file of a segments folder; None for other names."""
    return None if file == MANIFEST or not is_ours(file) else file.rpartition("-")[2].partition(".")[0]


def is_plain_path(raw: bytes) -> bool:
    """Whether a path, as the client wrote it, consists of plain names (Note [Plain names])."""
    return _PATH.fullmatch(raw) is not None and not {b".", b".."} & set(raw.split(b"/"))


def open_below(folder: Path, *parts: str) -> FileBytes | None:
    """The regular file ``folder/parts[0]/...``; None if there is none that may be read (Note [No links]). The folder
    may itself be a link, because the user named it. Raises OSError if the system cannot open files now."""
    try:
        handle = _opened(folder, parts)
    except OSError as error:
        if error.errno in _MISSING:
            return None
        raise
    if stat.S_ISREG(os.fstat(handle).st_mode):
        return FileBytes(handle, name=parts[-1])
    os.close(handle)
    return None


def _opened(folder: Path, parts: tuple[str, ...]) -> int:
    """A file descriptor."""
    assert all(part not in ("", ".", "..") and "/" not in part for part in parts), "parts are plain names"
    handle = os.open(folder, os.O_RDONLY | os.O_CLOEXEC | os.O_DIRECTORY)
    for part, kind in zip(parts, [os.O_DIRECTORY] * (len(parts) - 1) + [0], strict=True):
        try:
            inner = os.open(part, _SAFELY | kind, dir_fd=handle)
        finally:
            os.close(handle)
        handle = inner
    return handle


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
    """A stream in the folder ``root``. What opens files blocks, and raises OSError if the system cannot open any."""

    root: Path  # the folder
    # of the folder of segments, of the folder of renditions (qualities), or of the file with its suffix; a rendition is
    # named FOLDER/RENDITION
    name: str
    kind: StreamKind  # how it is stored
    renditions: tuple[str, ...] = ()  # folders of segments in the folder of renditions, by rising bit rate

    @property
    def segments(self) -> tuple["ServedStream", ...]:
        """The streams of segments: itself, its renditions, or none."""
        if self.kind is StreamKind.SEGMENTS:
            return (self,)
        return tuple(ServedStream(self.root, f"{self.name}/{one}", StreamKind.SEGMENTS) for one in self.renditions)

    def open(self, file: str) -> FileBytes | None:
        """A file of its folder; None if there is none."""
        return open_below(self.root, *self.name.split("/"), file)

    def open_whole(self) -> FileBytes | None:
        """The file of a stream that is one file; None if it has been removed."""
        return open_below(self.root, self.name)

    def open_beside(self, suffix: str) -> FileBytes | None:
        """The side file of the stream with this suffix; None if there is none."""
        *folders, own = self.name.split("/")
        return open_below(self.root, *folders, side_path(Path(own), suffix).name)


class Catalog:
    """The streams of a folder, listed again when the last listing is a second old.

    A folder that itself holds segments or renditions is the only stream. A stream whose name is not plain (Note [Plain
    names]) is left out, with a warning. Raises PlayerError if ``folder`` is not a folder, cannot be read, or is itself
    a stream whose name is not plain.
    """

    def __init__(self, folder: Path, *, clock: Callable[[], float] = time.monotonic) -> None:
        if folder.is_file():
            raise PlayerError(f"{folder} is a file; serve takes a folder of streams: {folder.resolve().parent}.")
        self._folder = folder.resolve()
        self._clock = clock
        self._lock = threading.Lock()
        self._listed_at = -float("inf")
        self._found: Mapping[str, ServedStream] = {}
        self._left_out: set[str] = set()
        try:
            if not is_stream_name(self._folder.name) and self._itself() is not None:
                raise PlayerError(f"The stream {folder} cannot be served, because {PLAIN}; rename it.")
            self.found()
        except OSError as error:
            raise PlayerError(f"The folder {folder} cannot be read ({error.strerror}).") from None

    def found(self) -> Mapping[str, ServedStream]:
        """The streams by their names, sorted. Blocks; thread-safe. Raises OSError if the folder cannot be read."""
        with self._lock:
            if self._clock() - self._listed_at >= REFRESH_SECONDS:
                self._found = self._list()
                self._listed_at = self._clock()
            return self._found

    def _itself(self) -> ServedStream | None:
        return _in_folder(self._folder.parent, self._folder.name) if self._folder.name else None

    def _list(self) -> Mapping[str, ServedStream]:
        if (itself := self._itself()) is not None:
            found = [itself]
        else:
            with os.scandir(self._folder) as entries:
                streams = [_stream(self._folder, entry) for entry in islice(entries, MAX_ENTRIES)]
            found = sorted(filter(None, streams), key=lambda one: one.name)
        for one in found:
            if not is_stream_name(one.name) and one.name not in self._left_out:
                self._left_out.add(one.name)
                log.warning("The stream %r is not served, because %s; rename it.", one.name, PLAIN)
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
    if _opens(root, name, MANIFEST):
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
        listed = list_from_json(opened[: MAX_LIST_BYTES + 1], name=name)
    return [one.folder for one in sorted(listed, key=lambda one: one.bits_per_second)]


def _opens(root: Path, *parts: str) -> bool:
    if (opened := open_below(root, *parts)) is not None:
        opened.close()
    return opened is not None

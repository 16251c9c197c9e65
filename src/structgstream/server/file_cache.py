# SPDX-License-Identifier: Apache-2.0
"""Immutable files that are asked for often, in memory: many players ask for the newest files at the same time.

Note [Bounded pieces]
~~~~~~~~~~~~~~~~~~~~~
A response holds one piece of its file, never the file: a piece is copied out of the cache when the client has taken the
one before. So memory is the cache's bound plus one piece and one socket buffer a connection, however slow clients are.
"""

import asyncio
from collections import OrderedDict
from collections.abc import AsyncGenerator, Callable
from dataclasses import dataclass
from typing import Final

from anyio import to_thread

from structgstream.server.files import OpenedFile

PIECE_BYTES: Final = 64 * 1024
MOST_CACHED_BYTES: Final = 64 * 10**6
MOST_CACHED_FILE_BYTES: Final = 4 * 10**6

Opener = Callable[[], OpenedFile | None]
Key = tuple[str, str]
"""Names of the stream and of the file."""


@dataclass(frozen=True)
class Source:
    """Where a file's bytes come from: ``opened``, or the cache where that is None."""

    size_bytes: int
    opened: OpenedFile | None

    def close(self) -> None:
        """Closes the file, if there is one."""
        if self.opened is not None:
            self.opened.close()


class FileCache:
    """The immutable files that were asked for last.

    Args:
        most_bytes: of all files together.
        most_file_bytes: larger files are read from the disk each time.
    """

    def __init__(self, *, most_bytes: int = MOST_CACHED_BYTES, most_file_bytes: int = MOST_CACHED_FILE_BYTES) -> None:
        self._most_bytes = most_bytes
        self._most_file_bytes = most_file_bytes
        self._kept: OrderedDict[Key, bytes] = OrderedDict()
        self._reading: dict[Key, asyncio.Task[int | None]] = {}
        self.cached_bytes = 0

    async def source(self, key: Key, open_file: Opener) -> Source | None:
        """A file; None if there is none.

        Args:
            key: its names.
            open_file: opens it; called in a thread, once for all who ask at the same time.

        Raises:
            OSError: the system cannot open files now.
        """
        if key in self._kept:
            self._kept.move_to_end(key)
            return Source(len(self._kept[key]), None)
        if key not in self._reading:
            self._reading[key] = asyncio.create_task(self._read(key, open_file))
        # Whoever asked first may go away; the others wait on.
        size_bytes = await asyncio.shield(self._reading[key])
        if size_bytes is not None:
            return Source(size_bytes, None)
        opened = await to_thread.run_sync(open_file)
        return None if opened is None else Source(len(opened), opened)

    async def pieces(self, key: Key, source: Source, wanted: range, open_file: Opener) -> AsyncGenerator[bytes, None]:
        """The bytes ``wanted`` of a file (Note [Bounded pieces]). They end early if the file is gone meanwhile."""
        start, opened = wanted.start, source.opened
        try:
            while start < wanted.stop:
                count = min(PIECE_BYTES, wanted.stop - start)
                content = None if opened else self._kept.get(key)
                if content is not None:
                    piece = content[start : start + count]
                else:
                    opened = opened or await to_thread.run_sync(open_file)
                    piece = await to_thread.run_sync(opened.read, start, count) if opened else b""
                if not piece:
                    return
                start += len(piece)
                yield piece
        finally:
            if opened is not None:
                opened.close()

    async def _read(self, key: Key, open_file: Opener) -> int | None:
        """Reads a file into the cache, and returns its length; None if there is none, or it is too large."""
        try:
            content = await to_thread.run_sync(_content, open_file, self._most_file_bytes)
        finally:
            del self._reading[key]
        if content is None:
            return None
        self._kept[key] = content
        self.cached_bytes += len(content)
        while self.cached_bytes > self._most_bytes and len(self._kept) > 1:
            self.cached_bytes -= len(self._kept.popitem(last=False)[1])
        return len(content)


def _content(open_file: Opener, most_bytes: int) -> bytes | None:
    opened = open_file()
    if opened is None:
        return None
    with opened:
        return opened.read(0, len(opened)) if 0 < len(opened) <= most_bytes else None

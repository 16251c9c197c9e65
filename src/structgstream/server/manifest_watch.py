# SPDX-License-Identifier: Apache-2.0
"""The present manifest of a segments folder, and waiting for a newer one.

Note [One watcher]
~~~~~~~~~~~~~~~~~~
While anyone waits, one task a stream looks at the manifest's stat ten times a second; requests that come meanwhile use
what it found. The file is read when the stat changed. A stat that is younger than the file system's clock can tell
apart does not count as known, because the file may be replaced once more within the same tick.
"""

import asyncio
import gzip
import hashlib
import json
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Final

from anyio import to_thread

from structgstream.server.files import FileStamp, OpenedFile

LOOK_SECONDS: Final = 0.1
TICK_NS: Final = 100_000_000
"""Age from which on a stat is believed."""
MOST_MANIFEST_BYTES: Final = 8 * 10**6
MOST_SEQUENCE: Final = 2**53
FORMAT: Final = "structgstream-segments"


class BrokenManifest(Exception):
    """The file ``manifest.json`` is none; the message says why."""


@dataclass(frozen=True)
class Snapshot:
    """A manifest: its bytes, the same with gzip, a strong validator, and what a server needs of its content."""

    content: bytes
    zipped: bytes
    digest: str
    sequence: int
    live: bool
    values: dict[str, Any]


class ManifestWatch:
    """The manifest of one stream (Note [One watcher]).

    Args:
        opened: opens the file; called in a thread.
        clock: seconds that rise.
    """

    def __init__(self, opened: Callable[[], OpenedFile | None], *, clock: Callable[[], float] = time.monotonic) -> None:
        self._opened = opened
        self._clock = clock
        self._lock = asyncio.Lock()
        self._looked_at = -float("inf")
        self._stamp: FileStamp | None = None
        self._found: Snapshot | str | None = None  # a text says what is wrong with the manifest
        self._changed = asyncio.Event()
        self._watching: asyncio.Task[None] | None = None
        self.waiters = 0

    async def current(self) -> Snapshot | None:
        """The manifest, at most a tenth of a second old; None if there is none.

        Raises:
            BrokenManifest: the file is no manifest.
            OSError: the system cannot open files now.
        """
        async with self._lock:
            if self._clock() - self._looked_at >= LOOK_SECONDS:
                await self._look()
        if isinstance(self._found, str):
            raise BrokenManifest(self._found)
        return self._found

    async def newer(self, after: int, *, seconds: float) -> Snapshot | None:
        """The manifest once its sequence is past ``after`` or it has changed, or the present one after ``seconds``.

        A finished stream's is given at once.

        Raises:
            BrokenManifest: the file is no manifest.
            OSError: the system cannot open files now.
        """
        self.waiters += 1  # Before anything is awaited: those who come meanwhile see that someone waits.
        try:
            first = found = await self.current()
            with suppress(TimeoutError):
                async with asyncio.timeout(seconds):
                    while found is first and found is not None and found.live and found.sequence <= after:
                        changed = self._changed
                        if self._watching is None or self._watching.done():
                            self._watching = asyncio.create_task(self._watch())
                        await changed.wait()
                        found = await self.current()
        finally:
            self.waiters -= 1
        return found

    async def _watch(self) -> None:
        while self.waiters:
            async with self._lock:
                with suppress(OSError):  # Those who ask next are told.
                    await self._look()
            await asyncio.sleep(LOOK_SECONDS)

    async def _look(self) -> None:
        """Reads the file if it changed, and wakes those who wait."""
        before = self._found
        try:
            self._stamp, self._found = await to_thread.run_sync(self._read)
        except BrokenManifest as broken:
            self._stamp, self._found = None, str(broken)
        self._looked_at = self._clock()
        if self._found is not before and self._found != before:
            changed, self._changed = self._changed, asyncio.Event()
            changed.set()

    def _read(self) -> tuple[FileStamp | None, Snapshot | str | None]:
        opened = self._opened()
        if opened is None:
            return None, None
        with opened as file:
            if file.stamp == self._stamp:
                return self._stamp, self._found
            if len(file) > MOST_MANIFEST_BYTES:
                raise BrokenManifest(f"it has {len(file)} bytes, more than {MOST_MANIFEST_BYTES}")
            content = file.read(0, len(file))
        sure = time.time_ns() - file.stamp.modified_ns > TICK_NS
        same = isinstance(self._found, Snapshot) and self._found.content == content
        return file.stamp if sure else None, self._found if same else snapshot(content)


def snapshot(content: bytes) -> Snapshot:
    """The manifest in a file.

    Raises:
        BrokenManifest: it is none.
    """
    try:
        values = json.loads(content)
    except (ValueError, RecursionError):
        raise BrokenManifest("it is no JSON") from None
    if not isinstance(values, dict) or values.get("format") != FORMAT:
        raise BrokenManifest(f"its format is not {FORMAT}")
    sequence, live = values.get("sequence"), values.get("live")
    if isinstance(sequence, bool) or not isinstance(sequence, int) or not 0 <= sequence <= MOST_SEQUENCE:
        raise BrokenManifest(f"its sequence is not a number from 0 to {MOST_SEQUENCE}")
    if not isinstance(live, bool):
        raise BrokenManifest("it does not say whether the stream is live")
    digest = hashlib.sha256(content).hexdigest()[:32]
    return Snapshot(content, gzip.compress(content, 6, mtime=0), digest, sequence, live, values)

# SPDX-License-Identifier: Apache-2.0
"""Reads the current manifest of a segments folder, and waits for a newer one.

Note [One watcher]
~~~~~~~~~~~~~~~~~~
While requests wait, one task per stream reads the manifest ten times a second; other requests use its result.
"""

import asyncio
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Final

from anyio import to_thread

from structgstream.codec.container.byte_source import FileBytes
from structgstream.codec.segments.manifest import FORMAT, MANIFEST, MAX_MANIFEST_BYTES, Fields, parse_object
from structgstream.errors import StreamError
from structgstream.serve.streams import ServedStream

POLL_SECONDS: Final = 0.1


class BrokenManifest(Exception):
    """The file ``manifest.json`` is not a manifest; the message states why."""


@dataclass(frozen=True)
class Snapshot:
    """A manifest: its bytes and its fields."""

    content: bytes
    sequence: int
    live: bool
    fields: Fields = field(compare=False)

    def edge(self, name: str) -> float | None:
        """A number of the newest frame; None if the manifest has none."""
        try:
            return self.fields.fields("edge").number(name)
        except StreamError:
            return None


class ManifestWatch:
    """The manifest of one stream (Note [One watcher])."""

    def __init__(
        self, open_file: Callable[[], FileBytes | None], *, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._open_file = open_file
        self._clock = clock
        self._lock = asyncio.Lock()
        self._read_at = -float("inf")
        self._found: Snapshot | str | None = None  # a string is the error in the manifest
        self._changed = asyncio.Event()
        self._watching: asyncio.Task[None] | None = None
        self.waiters = 0

    async def current(self) -> Snapshot | None:
        """The manifest, at most a tenth of a second old; None if there is none. Raises BrokenManifest if the file is
        none, OSError if the system cannot open files now."""
        async with self._lock:
            if self._clock() - self._read_at >= POLL_SECONDS:
                await self._poll()
        if isinstance(self._found, str):
            raise BrokenManifest(self._found)
        return self._found

    async def newer(self, after: int, *, seconds: float) -> Snapshot | None:
        """The manifest when its sequence exceeds ``after`` or it changes, or the current one after ``seconds``; that
        of a finished stream at once. Raises as :meth:`current`."""
        self.waiters += 1  # Before the first await, so that concurrent requests see it.
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
                with suppress(OSError, StreamError):  # The next request raises it.
                    await self._poll()
            await asyncio.sleep(POLL_SECONDS)

    async def _poll(self) -> None:
        """Read the file if it has changed, and wake waiting requests."""
        before = self._found
        try:
            self._found = await to_thread.run_sync(self._read)
        except BrokenManifest as broken:
            self._found = str(broken)
        self._read_at = self._clock()
        if self._found != before:
            changed, self._changed = self._changed, asyncio.Event()
            changed.set()

    def _read(self) -> Snapshot | None:
        opened = self._open_file()
        if opened is None:
            return None
        with opened as file:
            if len(file) > MAX_MANIFEST_BYTES:
                raise BrokenManifest(f"{MANIFEST} has {len(file)} bytes; expected at most {MAX_MANIFEST_BYTES}.")
            content = file[:]
        if isinstance(self._found, Snapshot) and self._found.content == content:
            return self._found
        return snapshot(content)


def snapshot(content: bytes) -> Snapshot:
    """The manifest in a file. Raises BrokenManifest if it is not a manifest."""
    try:
        fields = parse_object(content, MANIFEST, max_bytes=MAX_MANIFEST_BYTES)
        if fields.text("format") != FORMAT:
            fields.refuse(f"has another format than {FORMAT}")
        return Snapshot(content, fields.whole("sequence", most=2**53 - 1), fields.flag("live"), fields)
    except StreamError as error:
        raise BrokenManifest(str(error)) from None


class Manifests:
    """The watchers of the streams of a server."""

    def __init__(self) -> None:
        self._watches: dict[str, ManifestWatch] = {}

    def watch(self, stream: ServedStream) -> ManifestWatch:
        """The only watcher of a stream of segments."""
        if stream.name not in self._watches:
            self._watches[stream.name] = ManifestWatch(lambda: stream.open(MANIFEST))
        return self._watches[stream.name]

    async def current(self, stream: ServedStream) -> Snapshot | None:
        """The manifest of a stream of segments; None if there is none or it is broken."""
        try:
            return await self.watch(stream).current()
        except BrokenManifest:
            return None

    @property
    def waiters(self) -> dict[str, int]:
        """Number of requests that wait for a newer manifest, by stream."""
        return {name: watch.waiters for name, watch in self._watches.items()}

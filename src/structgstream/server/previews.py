# SPDX-License-Identifier: Apache-2.0
"""Preview pictures of streams.

Note [Previews]
~~~~~~~~~~~~~~~
A picture beside the stream is taken as it is. Otherwise a process of its own renders one, with a low priority and
one at a time, so that neither the server's loop nor its memory knows a decoder, and a trainer on the same machine
hardly notices. It is rendered when someone asks, and again at the earliest after a minute and when there is another key
frame; until then those who ask get the older picture. Who asks first waits a little and may have to ask again, as the
list does by itself.
"""

import asyncio
import hashlib
import os
import sys
import time
from collections import OrderedDict
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Final

from anyio import to_thread

from structgstream.server.catalog import ServedStream, StreamKind

AGAIN_SECONDS: Final = 60.0
WAIT_SECONDS: Final = 5.0
RENDER_SECONDS: Final = 300.0
MOST_PICTURE_BYTES: Final = 2 * 10**6
MOST_KEPT_BYTES: Final = 32 * 10**6
MOST_QUEUED: Final = 32

_SIGNATURES = {b"\x89PNG\r\n\x1a\n": "image/png", b"\xff\xd8\xff": "image/jpeg", b"RIFF": "image/webp"}


@dataclass(frozen=True)
class Picture:
    """A picture file, and its strong validator."""

    content: bytes
    media_type: str
    etag: str


@dataclass(frozen=True)
class _Kept:
    """What was rendered of a key frame, and when; no picture where it could not be."""

    key: str
    picture: Picture | None
    made_at: float


Render = Callable[[ServedStream], Awaitable[bytes]]


class Previews:
    """The preview pictures of a server's streams (Note [Previews]).

    Args:
        render: makes a picture file of a stream; empty where that is not possible. None: only files are shown.
        clock: seconds that rise.
    """

    def __init__(self, render: Render | None, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._render = render
        self._clock = clock
        self._kept: OrderedDict[str, _Kept] = OrderedDict()
        self._running: dict[str, asyncio.Task[None]] = {}
        self._one = asyncio.Semaphore(1)

    async def picture(self, stream: ServedStream, key: str) -> Picture | None:
        """The stream's picture, maybe of an earlier key frame; None if there is none, or none yet.

        Args:
            stream: the stream.
            key: what changes with its newest key frame.
        """
        if (stored := await to_thread.run_sync(_stored, stream)) is not None:
            return stored
        kept = self._kept.get(stream.name)
        if kept is None or (kept.key != key and self._clock() - kept.made_at >= AGAIN_SECONDS):
            running = self._started(stream, key)
            if kept is None and running is not None:
                await asyncio.wait({running}, timeout=WAIT_SECONDS)
                kept = self._kept.get(stream.name)
        return None if kept is None else kept.picture

    def _started(self, stream: ServedStream, key: str) -> asyncio.Task[None] | None:
        """The task that renders the stream; None if there may be none."""
        if stream.name not in self._running and self._render is not None and len(self._running) < MOST_QUEUED:
            self._running[stream.name] = asyncio.create_task(self._make(stream, key, self._render))
        return self._running.get(stream.name)

    async def _make(self, stream: ServedStream, key: str, render: Render) -> None:
        try:
            async with self._one:
                picture = picture_in(await render(stream))
            self._kept[stream.name] = _Kept(key, picture, self._clock())
            self._kept.move_to_end(stream.name)
            while len(self._kept) > 1 and sum(map(_size, self._kept.values())) > MOST_KEPT_BYTES:
                self._kept.popitem(last=False)
        finally:
            del self._running[stream.name]


def _size(kept: _Kept) -> int:
    return 1000 + (len(kept.picture.content) if kept.picture else 0)


def picture_in(content: bytes) -> Picture | None:
    """A PNG, JPEG or WebP file as a picture; None for other bytes."""
    for signature, media_type in _SIGNATURES.items():
        if content.startswith(signature) and len(content) <= MOST_PICTURE_BYTES:
            return Picture(content, media_type, f'"{hashlib.sha256(content).hexdigest()[:32]}"')
    return None


def _stored(stream: ServedStream) -> Picture | None:
    """``preview.png`` or ``.jpg`` in a folder of segments, ``ball.preview.png`` or ``.jpg`` beside ``ball.sgs``."""
    for suffix in (".png", ".jpg"):
        whole = stream.kind is StreamKind.FILE
        opened = stream.open_beside(f".preview{suffix}") if whole else stream.open(f"preview{suffix}")
        if opened is not None:
            with opened:
                return picture_in(opened.read(0, min(len(opened), MOST_PICTURE_BYTES + 1)))
    return None


async def rendered_apart(stream: ServedStream) -> bytes:
    """A PNG made by ``preview_picture`` in a process of its own; empty if it fails or takes too long."""
    environment = {**os.environ, "CUDA_VISIBLE_DEVICES": "", "OMP_NUM_THREADS": "1"}  # A trainer may need the GPU.
    command = (sys.executable, "-m", "structgstream.server.preview_picture")
    process = await asyncio.create_subprocess_exec(
        *command, str(stream.root), stream.name, stream.kind.value,
        stdin=asyncio.subprocess.DEVNULL, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.DEVNULL,
        env=environment,
    )  # fmt: skip
    assert process.stdout is not None, "a pipe was asked for"
    content = b""
    try:
        async with asyncio.timeout(RENDER_SECONDS):
            while len(content) <= MOST_PICTURE_BYTES and (piece := await process.stdout.read(2**16)):
                content += piece
            if len(content) > MOST_PICTURE_BYTES:
                return b""  # It would wait for ever to be read.
            return content if await process.wait() == 0 else b""
    except TimeoutError:
        return b""
    finally:
        with suppress(ProcessLookupError):
            process.kill()
        await process.communicate()  # Its pipe is closed when what is left in it has been read.

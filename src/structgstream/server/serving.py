# SPDX-License-Identifier: Apache-2.0
"""The answers to requests for a stream's files."""

import asyncio
import hashlib
from collections.abc import AsyncGenerator, Coroutine, Mapping
from functools import partial
from typing import Final

from anyio import to_thread
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response

from structgstream.codec.container.records import footer_offset
from structgstream.codec.segments.quality_list import MOST_LIST_BYTES, QUALITIES
from structgstream.player.byte_range import requested_part
from structgstream.server.access import query_of
from structgstream.server.catalog import ServedStream, StreamKind
from structgstream.server.file_cache import PIECE_BYTES
from structgstream.server.files import OpenedFile
from structgstream.server.manifest_watch import Snapshot
from structgstream.server.metrics import Metrics
from structgstream.server.names import MANIFEST, hash_in_name
from structgstream.server.queries import accepts_gzip, knows
from structgstream.server.settings import Limits
from structgstream.server.streams import Streams
from structgstream.server.transfer import PieceResponse, client_gone

YEAR_SECONDS: Final = 31536000


class Serving:
    """Answers requests for files of streams.

    Args:
        streams: the server's streams.
        metrics: counts viewers.
        limits: bounds of those who wait.
        headers: of every answer.
        visible: ``public`` where caches on the way may keep what is served, else ``private``.
    """

    def __init__(
        self, streams: Streams, metrics: Metrics, limits: Limits, *, headers: Mapping[str, str], visible: str
    ) -> None:
        self._streams = streams
        self._metrics = metrics
        self._limits = limits
        self._headers = headers
        self._visible = visible

    async def answer(self, stream: ServedStream, file: str, request: Request) -> Response:
        """The answer to a request for a file of a stream."""
        digest = hash_in_name(file)
        if file == "preview":
            return await self._preview(stream, request)
        if stream.kind is StreamKind.QUALITIES and file == QUALITIES:
            return await self._qualities(stream, request)
        if stream.kind is StreamKind.SEGMENTS and file == MANIFEST:
            return await self._manifest(stream, request)
        if stream.kind is StreamKind.SEGMENTS and digest is not None:
            return await self._immutable(stream, file, digest, request)
        if stream.kind is StreamKind.FILE and file in ("stream.sgs", "state"):
            return await self._growing(stream, request, state=file == "state")
        return self._nothing(stream)

    def _nothing(self, stream: ServedStream) -> Response:
        return PlainTextResponse(f"{stream.name} has no such file.", 404, self._headers)

    def _seen(self, stream: ServedStream, request: Request) -> None:
        self._metrics.viewers.see(stream.name, request.scope.get("client"))

    async def _qualities(self, stream: ServedStream, request: Request) -> Response:
        request.scope["answered"] = (stream.name, "qualities")
        opened = await to_thread.run_sync(stream.open, QUALITIES)
        if opened is None:
            return self._nothing(stream)
        with opened:
            content = await to_thread.run_sync(opened.read, 0, min(len(opened), MOST_LIST_BYTES))
        etag = f'"{hashlib.sha256(content).hexdigest()[:32]}"'
        headers = {**self._headers, "Cache-Control": self._asked_again, "ETag": etag}
        if knows(request.headers, etag):
            return Response(status_code=304, headers=headers)
        return Response(content, headers=headers, media_type="application/json")

    @property
    def _asked_again(self) -> str:
        """What caches are told of what changes."""
        return "no-cache" if self._visible == "public" else "private, no-cache"

    async def _manifest(self, stream: ServedStream, request: Request) -> Response:
        request.scope["answered"] = (stream.name, "manifest")
        self._seen(stream, request)
        watch, after = self._streams.watch(stream), query_of(request).after
        full = self._streams.waiters >= self._limits.waiters
        if after is None or full or request.method == "HEAD":
            found = await watch.current()
        else:
            found = await _unless_gone(watch.newer(after, seconds=self._limits.wait_seconds), request)
        if found is None:
            return self._nothing(stream)
        return self._snapshot(found, request, retry_seconds=2 if full and after is not None else 0)

    def _snapshot(self, found: Snapshot, request: Request, *, retry_seconds: int) -> Response:
        zipped = accepts_gzip(request.headers)
        etags = (f'"{found.digest}"', f'"{found.digest}-gzip"')
        headers = {
            **self._headers,
            "Cache-Control": self._asked_again,
            "ETag": etags[zipped],
            "Vary": "Accept-Encoding",
            **({"Retry-After": str(retry_seconds)} if retry_seconds else {}),
        }
        if knows(request.headers, *etags):
            return Response(status_code=304, headers=headers)
        if zipped:
            headers["Content-Encoding"] = "gzip"
        content = found.zipped if zipped else found.content
        return Response(content, headers=headers, media_type="application/json")

    async def _immutable(self, stream: ServedStream, file: str, digest: str, request: Request) -> Response:
        request.scope["answered"] = (stream.name, file.partition("-")[0])
        etag = f'"{digest}"'
        key, open_file = (stream.name, file), partial(stream.open, file)
        source = await self._streams.files.source(key, open_file)
        if source is None:
            return self._nothing(stream)
        kept = f"{self._visible}, max-age={YEAR_SECONDS}, immutable"
        headers = {**self._headers, "Cache-Control": kept, "ETag": etag}
        if knows(request.headers, etag):
            source.close()
            return Response(status_code=304, headers=headers)
        part = requested_part(request.headers, source.size_bytes, etag=etag)
        headers |= part.headers
        media_type = "application/json" if file.endswith(".json") else "application/octet-stream"
        if request.method == "HEAD" or part.status == 416:
            source.close()
            return Response(status_code=part.status, headers=headers, media_type=media_type)
        pieces = self._streams.files.pieces(key, source, part.wanted, open_file)
        return PieceResponse(pieces, status_code=part.status, headers=headers, media_type=media_type)

    async def _growing(self, stream: ServedStream, request: Request, *, state: bool) -> Response:
        """Bytes, or length, of a stream that is one file: as ``play`` serves it, without validators."""
        request.scope["answered"] = (stream.name, "state" if state else "file")
        self._seen(stream, request)
        opened = await to_thread.run_sync(stream.open_whole)
        if opened is None:
            return self._nothing(stream)
        if state:
            with opened:
                values = {"bytes": len(opened), "complete": footer_offset(opened) is not None}
            return JSONResponse(values, headers=self._headers)
        part = requested_part(request.headers, len(opened))
        headers = {**self._headers, **part.headers}
        if request.method == "HEAD" or part.status == 416:
            opened.close()
            return Response(status_code=part.status, headers=headers, media_type="application/octet-stream")
        return PieceResponse(
            _pieces(opened, part.wanted),
            status_code=part.status,
            headers=headers,
            media_type="application/octet-stream",
        )

    async def _preview(self, stream: ServedStream, request: Request) -> Response:
        request.scope["answered"] = (stream.name, "preview")
        found = await self._streams.preview(stream)
        if found is None:
            text = f"{stream.name} has no preview picture yet."
            return PlainTextResponse(text, 404, {**self._headers, "Retry-After": "30"})
        headers = {**self._headers, "Cache-Control": f"{self._visible}, max-age=30", "ETag": found.etag}
        if knows(request.headers, found.etag):
            return Response(status_code=304, headers=headers)
        return Response(found.content, headers=headers, media_type=found.media_type)


async def _pieces(opened: OpenedFile, wanted: range) -> AsyncGenerator[bytes, None]:
    """The bytes ``wanted`` of a file, which is closed after them. They end early if it becomes shorter meanwhile."""
    with opened:
        for start in range(wanted.start, wanted.stop, PIECE_BYTES):
            piece = await to_thread.run_sync(opened.read, start, min(PIECE_BYTES, wanted.stop - start))
            if not piece:
                return
            yield piece


async def _unless_gone(waiting: Coroutine[None, None, Snapshot | None], request: Request) -> Snapshot | None:
    """What is waited for; None once the client is gone."""
    task, gone = asyncio.create_task(waiting), asyncio.create_task(client_gone(request.receive))
    try:
        await asyncio.wait({task, gone}, return_when=asyncio.FIRST_COMPLETED)
        return task.result() if task.done() else None
    finally:
        task.cancel()
        gone.cancel()

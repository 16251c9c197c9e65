# SPDX-License-Identifier: Apache-2.0
"""The web application of ``structgstream serve``.

Note [What is served]
~~~~~~~~~~~~~~~~~~~~~
Addresses consist of plain names, and each name is looked up. Only streams of the folder are served, and of these only
the files that a sink writes, previews and the metrics of the run. With keys every address needs a token except
``/health``, ``/player.js`` and ``/streams/NAME`` without a slash at its end, which redirects for any name. The token is
checked before the stream is looked up, so that responses do not reveal which streams exist.

docs/serve.md lists the addresses. The reverse proxy in front bounds connections, rates and slow clients.
"""

import asyncio
import re
import time
from collections.abc import Callable, Coroutine, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeVar

from anyio import to_thread
from prometheus_client import CONTENT_TYPE_LATEST
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.middleware.cors import CORSMiddleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, PlainTextResponse, RedirectResponse, Response
from starlette.routing import Route

from structgstream.codec.container.byte_source import FileBytes
from structgstream.codec.segments.manifest import MANIFEST
from structgstream.codec.segments.quality_list import MAX_LIST_BYTES, QUALITIES
from structgstream.errors import StreamError
from structgstream.serve.access import EVERY_STREAM, Access, Authorizer, Refused, TokenKeys, refusal
from structgstream.serve.listening import LOOPBACK_NAMES
from structgstream.serve.manifest_watch import BrokenManifest, Manifests, Snapshot
from structgstream.serve.metrics import CountRequests, Metrics, exposition, run_numbers, stream_families
from structgstream.serve.pages import SERVED_POLICY, bundle, file_state, linked_page, list_page, policy
from structgstream.serve.responses import NO_STORE_HEADERS, content_response, file_response
from structgstream.serve.streams import (
    Catalog,
    ServedStream,
    StreamKind,
    hash_in_name,
    is_plain_path,
    is_stream_name,
)

T = TypeVar("T")
YEAR_SECONDS: Final = 31536000
MAX_RUN_BYTES: Final = 256 * 1024
MAX_PICTURE_BYTES: Final = 2 * 10**6
METHODS: Final = ("GET", "HEAD", "OPTIONS")
REQUEST_HEADERS: Final = ("Authorization", "Range", "If-Range", "If-None-Match")
EXPOSED_HEADERS: Final = ("ETag", "Content-Range", "Content-Length", "Accept-Ranges")
_PICTURES: Final = {b"\x89PNG\r\n\x1a\n": "image/png", b"\xff\xd8\xff": "image/jpeg"}
_SEQUENCE: Final = re.compile(r"[0-9]{1,16}", re.ASCII)
_NOTHING_HERE: Final = "There is nothing at this address."


@dataclass(frozen=True)
class ServerSettings:
    """Settings of the server."""

    folder: Path  # contains the streams, or is one
    keys: TokenKeys | None = None  # secrets of access tokens; None gives everyone access
    origins: tuple[str, ...] = ()  # origins whose pages may read responses, * for all; empty: only pages of this server
    hosts: tuple[str, ...] = LOOPBACK_NAMES  # host names that requests may have; * for any
    wait_seconds: float = 25.0  # longest time that a request waits for a newer manifest


def application(settings: ServerSettings, *, clock: Callable[[], float] = time.time) -> Starlette:
    """The application (Note [What is served]). Raises PlayerError if the folder cannot be read, or the installation
    lacks the player."""
    metrics = Metrics()
    middleware = [
        Middleware(TrustedHostMiddleware, allowed_hosts=list(settings.hosts), www_redirect=False),
        Middleware(CountRequests, metrics=metrics),
    ]
    if settings.origins:
        cors = Middleware(
            CORSMiddleware,
            allow_origins=settings.origins,
            allow_methods=METHODS,
            allow_headers=REQUEST_HEADERS,
            expose_headers=EXPOSED_HEADERS,
            max_age=86400,
        )
        middleware.insert(0, cors)
    application = Starlette(
        routes=_Routes(settings, metrics, clock).all(),
        middleware=middleware,
        exception_handlers={
            HTTPException: _unrouted,
            Refused: _refused,
            BrokenManifest: _broken,
            OSError: _unreadable,
            StreamError: _unreadable,
        },
    )
    application.router.redirect_slashes = False  # A redirect would name this server's host, also behind a proxy.
    return application


class _Routes:
    """The routes of one server."""

    def __init__(self, settings: ServerSettings, metrics: Metrics, clock: Callable[[], float]) -> None:
        self._catalog = Catalog(settings.folder)
        self._manifests = Manifests()
        self._authorizer = Authorizer(settings.keys, clock=clock)
        self._metrics = metrics
        self._clock = clock
        self._wait_seconds = settings.wait_seconds
        self._visibility = "public" if settings.keys is None else "private"
        self._revalidated = "no-cache" if settings.keys is None else "private, no-cache"  # content that changes
        shared = "cross-origin" if settings.origins else "same-origin"
        self._headers = {**NO_STORE_HEADERS, "Cross-Origin-Resource-Policy": shared}
        self._module = bundle()

    def all(self) -> list[Route]:
        """The routes, in order of matching."""
        return [
            Route("/", self.index),
            Route("/streams.json", self.listing),
            Route("/player.js", self.player),
            Route("/health", self.health),
            Route("/metrics", self.metrics),
            Route("/streams/{name}", self.without_slash),
            Route("/streams/{name}/", self.page),
            Route("/streams/{name}/{file}", self.file),
            Route("/streams/{name}/{rendition}/{file}", self.file),
        ]

    async def index(self, request: Request) -> Response:
        """The page of all streams that the token gives access to."""
        return self._html(list_page(await self._listed(request), query=self._authorizer.page_query(request)))

    async def listing(self, request: Request) -> Response:
        """The same as JSON."""
        return JSONResponse({"streams": await self._listed(request)}, headers=self._headers)

    async def player(self, request: Request) -> Response:
        """The player's module, which is the same for everyone."""
        request.scope["counted_as"] = ("", "player")
        headers = {**self._headers, "Cache-Control": "public, max-age=300"}
        return Response(self._module, media_type="text/javascript", headers=headers)

    async def health(self, request: Request) -> Response:
        """Whether the folder can be read."""
        request.scope["counted_as"] = ("", "health")
        await self._streams()
        return JSONResponse({"status": "ok"}, headers=self._headers)

    async def metrics(self, request: Request) -> Response:
        """Counters and gauges."""
        request.scope["counted_as"] = ("", "metrics")
        self._authorizer.check(request, EVERY_STREAM)
        streams = (await self._streams()).values()
        segments = [one for stream in streams for one in stream.segments]
        manifests = {one.name: found for one in segments if (found := await self._manifests.current(one))}
        runs = {stream.name: await to_thread.run_sync(_run_numbers, stream) for stream in streams}
        gauges = stream_families(manifests, waiters=self._manifests.waiters, runs=runs, unix_seconds=self._clock())
        content = exposition([*self._metrics.families(), *gauges])
        return Response(content, headers={**self._headers, "Content-Type": CONTENT_TYPE_LATEST})

    async def without_slash(self, request: Request) -> Response:
        """Redirects to the page; the redirect is relative, so that it works behind a proxy."""
        _check_plain(request)
        name, query = request.path_params["name"], request.scope["query_string"].decode("ascii")
        return RedirectResponse(f"{name}/{'?' if query else ''}{query}", 307, self._headers)

    async def page(self, request: Request) -> Response:
        """The page of a stream, which passes the token to the player."""
        stream = await self._stream(request)
        request.scope["counted_as"] = (stream.name, "page")
        address = f"{stream.kind.source}{self._authorizer.page_query(request)}"
        page = linked_page(stream.name, stream=address, module="../../player.js")
        return self._html(page, **SERVED_POLICY)

    async def file(self, request: Request) -> Response:
        """A file of a stream or of one of its renditions."""
        stream, file = await self._stream(request), request.path_params["file"]
        if file == "preview":
            return await self._preview(stream, request)
        if stream.kind is StreamKind.QUALITIES and file == QUALITIES:
            return await self._renditions(stream, request)
        if stream.kind is StreamKind.SEGMENTS and file == MANIFEST:
            return await self._manifest(stream, request)
        if stream.kind is StreamKind.SEGMENTS and hash_in_name(file) is not None:
            return await self._immutable(stream, file, request)
        if stream.kind is StreamKind.FILE and file in ("stream.sgs", "state"):
            return await self._growing(stream, request, state=file == "state")
        raise Refused(404, f"{stream.name} has no such file.")

    def _html(self, page: str, **sources: str) -> Response:
        rules = policy(**sources, frame_ancestors="'self'")
        return HTMLResponse(page, headers={**self._headers, "Content-Security-Policy": rules})

    def _small(self, content: bytes, request: Request, caching: str, media_type: str) -> Response:
        return content_response(content, request, {**self._headers, "Cache-Control": caching}, media_type=media_type)

    async def _streams(self) -> Mapping[str, ServedStream]:
        return await to_thread.run_sync(self._catalog.found)

    async def _stream(self, request: Request) -> ServedStream:
        """The stream, or the rendition of it, that the address names."""
        _check_plain(request)
        name, rendition = request.path_params["name"], request.path_params.get("rendition")
        self._authorizer.check(request, name)
        found = (await self._streams()).get(name) if is_stream_name(name) else None
        if found is not None and rendition is not None:
            found = next((one for one in found.segments if one.name == f"{name}/{rendition}"), None)
        if found is None:
            raise Refused(404, _NOTHING_HERE)
        return found

    async def _listed(self, request: Request) -> list[dict[str, Any]]:
        """The entries of the streams that the token gives access to; addresses are relative."""
        request.scope["counted_as"] = ("", "list")
        streams = (await self._streams()).values()
        visible = [one for one in streams if self._authorizer.access(request, one.name) is Access.GRANTED]
        access = self._authorizer.access(request, EVERY_STREAM)
        if not visible and access not in (Access.GRANTED, Access.OTHER_STREAM):
            raise refusal(access)
        return [await self._entry(one) for one in visible]

    async def _entry(self, stream: ServedStream) -> dict[str, Any]:
        found = await self._manifests.current(stream.segments[0]) if stream.segments else None
        base = f"streams/{stream.name}/"
        return {
            "name": stream.name,
            "kind": stream.kind.value,
            "live": None if found is None else found.live,
            "seconds": None if found is None else found.edge("pts_seconds"),
            "page": base,
            "stream": f"{base}{stream.kind.source}",
            "preview": f"{base}preview",
        }

    async def _renditions(self, stream: ServedStream, request: Request) -> Response:
        request.scope["counted_as"] = (stream.name, "qualities")
        content = _found(await _content(await to_thread.run_sync(stream.open, QUALITIES), MAX_LIST_BYTES), stream)
        return self._small(content, request, self._revalidated, "application/json")

    async def _manifest(self, stream: ServedStream, request: Request) -> Response:
        request.scope["counted_as"] = (stream.name, "manifest")
        self._metrics.viewers.see(stream.name, request.scope.get("client"))
        watch, after = self._manifests.watch(stream), _after(request)
        if after is None or request.method == "HEAD":
            found = await watch.current()
        else:
            found = await _while_connected(watch.newer(after, seconds=self._wait_seconds), request)
        return self._small(_found(found, stream).content, request, self._revalidated, "application/json")

    async def _immutable(self, stream: ServedStream, file: str, request: Request) -> Response:
        request.scope["counted_as"] = (stream.name, file.partition("-")[0])
        opened = _found(await to_thread.run_sync(stream.open, file), stream)
        headers = {**self._headers, "Cache-Control": f"{self._visibility}, max-age={YEAR_SECONDS}, immutable"}
        media_type = "application/json" if file.endswith(".json") else "application/octet-stream"
        return file_response(opened, request, headers, etag=f'"{hash_in_name(file)}"', media_type=media_type)

    async def _growing(self, stream: ServedStream, request: Request, *, state: bool) -> Response:
        """Bytes, or length, of a stream that is one file; without validators, because it may grow."""
        request.scope["counted_as"] = (stream.name, "state" if state else "file")
        self._metrics.viewers.see(stream.name, request.scope.get("client"))
        opened = _found(await to_thread.run_sync(stream.open_whole), stream)
        if not state:
            return file_response(opened, request, self._headers)
        with opened:
            return JSONResponse(file_state(opened), headers=self._headers)

    async def _preview(self, stream: ServedStream, request: Request) -> Response:
        """``preview.png`` or ``.jpg`` of segments, else ``NAME.preview.png`` or ``.jpg`` next to the stream."""
        request.scope["counted_as"] = (stream.name, "preview")
        content = await _content(await to_thread.run_sync(_open_preview, stream), MAX_PICTURE_BYTES)
        media_type = next((kind for start, kind in _PICTURES.items() if (content or b"").startswith(start)), None)
        if content is None or media_type is None:
            raise Refused(404, f"{stream.name} has no preview picture.")
        return self._small(content, request, f"{self._visibility}, max-age=30", media_type)


def _found(something: T | None, stream: ServedStream) -> T:
    """What a stream has; 404 for nothing."""
    if something is None:
        raise Refused(404, f"{stream.name} has no such file.")
    return something


def _check_plain(request: Request) -> None:
    """Check that the path consists of plain names."""
    if not is_plain_path(request.scope["raw_path"]):
        raise Refused(404, _NOTHING_HERE)


def _after(request: Request) -> int | None:
    """The sequence of the manifest that the client has; None if it does not wait for a newer one."""
    given = request.query_params.get("after", "0")
    if not _SEQUENCE.fullmatch(given):
        raise Refused(400, "The query's after is not a sequence number.")
    return int(given) if "after" in request.query_params else None


def _open_preview(stream: ServedStream) -> FileBytes | None:
    for suffix in (".png", ".jpg"):
        segments = stream.segments[-1:]  # the best of several renditions
        opened = segments[0].open(f"preview{suffix}") if segments else stream.open_beside(f".preview{suffix}")
        if opened is not None:
            return opened
    return None


def _run_numbers(stream: ServedStream) -> dict[str, float]:
    opened = stream.open_beside(".metrics.json")
    if opened is None:
        return {}
    with opened:
        return run_numbers(opened[:MAX_RUN_BYTES])


async def _content(opened: FileBytes | None, max_bytes: int) -> bytes | None:
    """The content of a small file; None if there is no file, or it is larger."""
    if opened is None:
        return None
    with opened:
        return await to_thread.run_sync(opened.__getitem__, slice(None)) if len(opened) <= max_bytes else None


async def _while_connected(waiting: Coroutine[None, None, Snapshot | None], request: Request) -> Snapshot | None:
    """The result of ``waiting``; None if the client disconnects before."""

    async def disconnected() -> None:
        while (await request.receive())["type"] != "http.disconnect":
            pass

    task, gone = asyncio.create_task(waiting), asyncio.create_task(disconnected())
    try:
        await asyncio.wait({task, gone}, return_when=asyncio.FIRST_COMPLETED)
        return task.result() if task.done() else None
    finally:
        task.cancel()
        gone.cancel()


async def _refused(request: Request, error: Exception) -> Response:
    assert isinstance(error, Refused), "the exception of this handler"
    return PlainTextResponse(error.text, error.status, {**NO_STORE_HEADERS, **error.headers})


async def _unrouted(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException), "the exception of this handler"
    text = "Only GET and HEAD are answered." if error.status_code == 405 else _NOTHING_HERE
    return PlainTextResponse(text, error.status_code, {**NO_STORE_HEADERS, **(error.headers or {})})


async def _broken(request: Request, error: Exception) -> Response:
    return PlainTextResponse(f"The stream's manifest.json is no manifest: {error}", 502, NO_STORE_HEADERS)


async def _unreadable(request: Request, error: Exception) -> Response:
    return PlainTextResponse(
        "The streams cannot be read now; try again.", 503, {**NO_STORE_HEADERS, "Retry-After": "5"}
    )

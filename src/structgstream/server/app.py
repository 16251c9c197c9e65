# SPDX-License-Identifier: Apache-2.0
"""The web application of ``structgstream serve``.

Note [What is exposed]
~~~~~~~~~~~~~~~~~~~~~~
Addresses name streams and files with plain names, and each name is looked up: only streams of the folder, and of those
only the files that a sink writes, previews and the numbers of the run. With keys every address but ``/health``,
``/player.js`` needs a token; that is checked before anything is looked for, so that nobody learns which streams exist.

==================================  ==========================================================
``/``, ``/streams.json``            the streams that the token opens
``/streams/NAME/``                  the player
``/streams/NAME/manifest.json``     the manifest; ``?after=N`` waits for one that is newer
``/streams/NAME/FILE``              an immutable file of the segments
``/streams/NAME/qualities.json``    the qualities of a stream
``/streams/NAME/QUALITY/FILE``      manifest and files of one of them, as above
``/streams/NAME/stream.sgs``        the bytes of a stream that is one file, which may grow
``/streams/NAME/state``             of such a file: length, and whether it is complete
``/streams/NAME/preview``           a picture
``/metrics``, ``/health``           for those who run the server
==================================  ==========================================================
"""

import time
from collections.abc import Callable

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.middleware.cors import CORSMiddleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, PlainTextResponse, RedirectResponse, Response
from starlette.routing import Route

from structgstream.player.bundle import bundle
from structgstream.player.page import SERVED_POLICY, linked_page, policy
from structgstream.server.access import Gate, Refused
from structgstream.server.catalog import Catalog
from structgstream.server.guard import METHODS, Guard
from structgstream.server.manifest_watch import BrokenManifest
from structgstream.server.metrics import CONTENT_TYPE, Family, Metrics, exposition
from structgstream.server.pages import LIST_POLICY, list_page
from structgstream.server.previews import Render, rendered_apart
from structgstream.server.serving import Serving
from structgstream.server.settings import PASSING, ServerSettings
from structgstream.server.streams import Streams
from structgstream.server.tokens import EVERY_STREAM

READ_HEADERS = ("Authorization", "Range", "If-Range", "If-None-Match")
TOLD_HEADERS = ("ETag", "Content-Range", "Content-Length", "Accept-Ranges", "Retry-After")


def application(
    settings: ServerSettings,
    *,
    metrics: Metrics,
    open_connections: Callable[[], int] = lambda: 0,
    render: Render = rendered_apart,
    clock: Callable[[], float] = time.time,
) -> Starlette:
    """The application (Note [What is exposed]).

    Args:
        settings: what is served, and to whom.
        metrics: counts.
        open_connections: how many the server has, for the metrics.
        render: makes previews, unless the settings forbid it.
        clock: Unix seconds, which tokens expire by.

    Raises:
        PlayerError: the folder cannot be read, or the installation lacks the player.
    """
    streams = Streams(Catalog(settings.folder), render=render if settings.previews else None, clock=clock)
    routes = _Routes(settings, streams, metrics, Gate(settings.keys, streams, clock=clock), open_connections)
    middleware = [
        Middleware(TrustedHostMiddleware, allowed_hosts=list(settings.hosts), www_redirect=False),
        Middleware(Guard, limits=settings.limits, metrics=metrics),
    ]
    if settings.origins:
        middleware.insert(
            0,
            Middleware(
                CORSMiddleware,
                allow_origins=settings.origins,
                allow_methods=METHODS,
                allow_headers=READ_HEADERS,
                expose_headers=TOLD_HEADERS,
                max_age=86400,
            ),
        )
    application = Starlette(
        routes=routes.all(),
        middleware=middleware,
        exception_handlers={
            HTTPException: _unrouted,
            Refused: _refused,
            BrokenManifest: _broken,
            OSError: _unreadable,
        },
    )
    application.router.redirect_slashes = False  # It would lead to this server's own name, also behind a proxy.
    return application


class _Routes:
    """The routes of one server."""

    def __init__(
        self,
        settings: ServerSettings,
        streams: Streams,
        metrics: Metrics,
        gate: Gate,
        open_connections: Callable[[], int],
    ) -> None:
        self._gate = gate
        self._open_connections = open_connections
        self._streams = streams
        self._metrics = metrics
        self._shared = "cross-origin" if settings.origins else "same-origin"
        self._passing = {**PASSING, "Cross-Origin-Resource-Policy": self._shared}
        self._serving = Serving(
            streams,
            metrics,
            settings.limits,
            headers={**self._passing},
            visible="public" if settings.keys is None else "private",
        )
        self._module = bundle()

    def all(self) -> list[Route]:
        """The routes, in the order in which they are tried."""
        return [
            Route("/", self.index),
            Route("/streams.json", self.list),
            Route("/player.js", self.player),
            Route("/health", self.health),
            Route("/metrics", self.metrics),
            Route("/streams/{name}", self.without_slash),
            Route("/streams/{name}/", self.page),
            Route("/streams/{name}/{file}", self.file),
            Route("/streams/{name}/{quality}/{file}", self.file_of_quality),
        ]

    async def index(self, request: Request) -> Response:
        """The page of all streams that the token opens."""
        request.scope["answered"] = ("", "list")
        listed = [await self._streams.listed(stream) for stream in await self._gate.visible(request)]
        page = list_page(listed, query=self._gate.passed_on(request))
        return HTMLResponse(page, headers={**self._passing, "Content-Security-Policy": LIST_POLICY})

    async def list(self, request: Request) -> Response:
        """The same as values."""
        request.scope["answered"] = ("", "list")
        listed = [await self._streams.listed(stream) for stream in await self._gate.visible(request)]
        return JSONResponse({"streams": [entry.as_json() for entry in listed]}, headers=self._passing)

    async def player(self, request: Request) -> Response:
        """The player's module, which is the same for everyone."""
        request.scope["answered"] = ("", "player")
        headers = {**self._passing, "Cache-Control": "public, max-age=300"}
        return Response(self._module, media_type="text/javascript", headers=headers)

    async def health(self, request: Request) -> Response:
        """Whether the folder can be read."""
        request.scope["answered"] = ("", "health")
        await self._streams.all()
        return JSONResponse({"status": "ok"}, headers=self._passing)

    async def metrics(self, request: Request) -> Response:
        """Counters and gauges."""
        request.scope["answered"] = ("", "metrics")
        self._gate.check(request, EVERY_STREAM)
        open_now = Family("structgstream_connections", "gauge", "Open.", [({}, float(self._open_connections()))])
        text = exposition([*self._metrics.families(), open_now, *await self._streams.families()])
        return Response(text, headers={**self._passing, "Content-Type": CONTENT_TYPE})

    async def without_slash(self, request: Request) -> Response:
        """Leads to the page; relative, so that it holds behind a proxy."""
        name, query = request.path_params["name"], request.scope["query_string"].decode("ascii")
        return RedirectResponse(f"{name}/{'?' if query else ''}{query}", 307, self._passing)

    async def page(self, request: Request) -> Response:
        """The player of a stream, with the token in the addresses that it asks for."""
        stream = await self._gate.stream(request)
        request.scope["answered"] = (stream.name, "page")
        address = f"{stream.kind.source}{self._gate.passed_on(request)}"
        page = linked_page(stream.name, stream=address, module="../../player.js")
        rules = policy(**SERVED_POLICY, frame_ancestors="'self'")
        return HTMLResponse(page, headers={**self._passing, "Content-Security-Policy": rules})

    async def file(self, request: Request) -> Response:
        """One file of a stream."""
        stream = await self._gate.stream(request)
        return await self._serving.answer(stream, request.path_params["file"], request)

    async def file_of_quality(self, request: Request) -> Response:
        """One file of one of the qualities of a stream."""
        quality = await self._gate.quality(request)
        return await self._serving.answer(quality, request.path_params["file"], request)


async def _refused(request: Request, error: Exception) -> Response:
    assert isinstance(error, Refused), "what the handler is for"
    return PlainTextResponse(error.text, error.status, {**PASSING, **error.headers})


async def _unrouted(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException), "what the handler is for"
    text = "Only GET and HEAD are answered." if error.status_code == 405 else "There is nothing at this address."
    return PlainTextResponse(text, error.status_code, {**PASSING, **(error.headers or {})})


async def _broken(request: Request, error: Exception) -> Response:
    return PlainTextResponse(f"The stream's manifest.json is no manifest: {error}.", 502, PASSING)


async def _unreadable(request: Request, error: Exception) -> Response:
    return PlainTextResponse("The streams cannot be read now; try again.", 503, {**PASSING, "Retry-After": "5"})

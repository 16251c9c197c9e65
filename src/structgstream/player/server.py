# SPDX-License-Identifier: Apache-2.0
"""The web application of ``structgstream play``: page, player, stream, and the capture's pictures.

Note [Only this machine]
~~~~~~~~~~~~~~~~~~~~~~~~
The server listens on the loopback address, so any page open in a browser can reach it. Three measures protect it:
requests whose Host is not a name of this machine are refused, against DNS rebinding; no response allows another origin
to read it; and URLs name cameras and frames, never files.
"""

from collections.abc import Iterator, Mapping
from contextlib import suppress

from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, PlainTextResponse, Response, StreamingResponse
from starlette.routing import Route

from structgstream.codec.container.byte_source import FileBytes
from structgstream.codec.segments.stored_bytes import StoredBytes
from structgstream.errors import CaptureError, StreamError
from structgstream.player.bundle import bundle
from structgstream.player.byte_range import requested_part
from structgstream.player.page import SERVED_POLICY, linked_page, policy
from structgstream.player.stream_file import StreamFile, pieces
from structgstream.player.truth import Truth

LOOPBACK_NAMES = ("127.0.0.1", "localhost")
# A growing file may differ in each response, so responses are not cached and have no validators.
_HEADERS: Mapping[str, str] = {
    "Cache-Control": "no-store",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


def application(stream: StreamFile, *, truth: Truth | None = None) -> Starlette:
    """The application; each request opens the file anew, so it may grow meanwhile.

    Args:
        stream: the file to play.
        truth: the capture's pictures to compare with, or None.

    Raises:
        PlayerError: the installation lacks the player.
    """
    module = bundle()
    attributes = {"truth": "truth.json"} if truth else {}
    page = linked_page(stream.path.name, stream="stream", attributes=attributes)
    page_headers = {**_HEADERS, "Content-Security-Policy": policy(**SERVED_POLICY, frame_ancestors="'self'")}

    def index(request: Request) -> Response:
        return HTMLResponse(page, headers=page_headers)

    def player(request: Request) -> Response:
        return Response(module, media_type="text/javascript", headers=_HEADERS)

    def state(request: Request) -> Response:
        try:
            size_bytes, complete = stream.state()
        except StreamError as error:
            return _gone(error)
        return JSONResponse({"bytes": size_bytes, "complete": complete}, headers=_HEADERS)

    def stream_bytes(request: Request) -> Response:
        return _part_of(stream, request)

    def cameras(request: Request) -> Response:
        return JSONResponse(list(truth.cameras) if truth else [], headers=_HEADERS)

    def picture(request: Request) -> Response:
        if truth is None:
            return PlainTextResponse("No capture is served.", 404, _HEADERS)
        camera, frame = request.path_params["camera"], request.path_params["frame"]
        try:
            data = truth.jpeg(camera, frame)
        except CaptureError as error:
            return PlainTextResponse(str(error), 500, _HEADERS)
        if data is None:
            return PlainTextResponse("There is no such camera or frame.", 404, _HEADERS)
        return Response(data, media_type="image/jpeg", headers=_HEADERS)

    routes = [
        Route("/", index),
        Route("/player.js", player),
        Route("/state", state),
        Route("/stream", stream_bytes),
        Route("/truth.json", cameras),
        Route("/truth/{camera:path}/{frame:int}.jpg", picture),
    ]
    only_here = Middleware(TrustedHostMiddleware, allowed_hosts=list(LOOPBACK_NAMES), www_redirect=False)
    return Starlette(routes=routes, middleware=[only_here])


def _part_of(stream: StreamFile, request: Request) -> Response:
    """The response to a request for bytes of the stream, at its present length."""
    try:
        data = stream.opened()
    except StreamError as error:
        return _gone(error)
    part = requested_part(request.headers, len(data))
    headers = {**_HEADERS, **part.headers}
    if part.status == 416:
        data.close()
        return Response(status_code=416, headers=headers)
    if request.method == "HEAD":
        data.close()
        return Response(status_code=part.status, headers=headers, media_type="application/octet-stream")
    return StreamingResponse(_closing(data, part.wanted), part.status, headers, "application/octet-stream")


def _closing(data: FileBytes | StoredBytes, wanted: range) -> Iterator[bytes | memoryview]:
    with data, suppress(StreamError):  # If the file becomes shorter meanwhile, the response ends early.
        yield from pieces(data, wanted)


def _gone(error: StreamError) -> Response:
    return PlainTextResponse(str(error), 404, _HEADERS)

# SPDX-License-Identifier: Apache-2.0
"""What every request passes first: malformed and too frequent ones are refused; all are counted."""

import time
from collections.abc import Callable

from starlette.datastructures import Headers
from starlette.responses import PlainTextResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from structgstream.server.limits import Concurrent, TokenBuckets, client_key
from structgstream.server.metrics import Metrics
from structgstream.server.names import is_plain_path
from structgstream.server.settings import PASSING, Limits

METHODS = ("GET", "HEAD", "OPTIONS")


class Guard:
    """ASGI middleware that refuses what no player asks for, and counts.

    Routes tell what they answered: ``scope["answered"] = (stream, kind)``.

    Args:
        app: the application.
        limits: of an address and of a request.
        metrics: counts answers.
        clock: seconds that rise.
    """

    def __init__(
        self, app: ASGIApp, *, limits: Limits, metrics: Metrics, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._app = app
        self._limits = limits
        self._metrics = metrics
        self._buckets = TokenBuckets(limits.requests_per_second, limits.burst, most=limits.addresses, clock=clock)
        self._together = Concurrent(limits.connections_per_address, most_together=2 * limits.connections)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answers a request."""
        if scope["type"] != "http":
            return
        client = client_key(scope["client"][0] if scope.get("client") else "")
        status, sent = 500, 0

        async def counted(message: Message) -> None:
            nonlocal status, sent
            if message["type"] == "http.response.start":
                status = message["status"]
            await send(message)
            sent += 0 if scope["method"] == "HEAD" else len(message.get("body", b""))

        refusal = self._refusal(scope, client)
        entered = refusal is None and self._together.enter(client)
        if refusal is None and not entered:
            refusal = self._refused("requests_at_a_time", 429, "This address has too many requests at a time.", 1.0)
        try:
            await (self._app if refusal is None else refusal)(scope, receive, counted)
        finally:
            if entered:
                self._together.leave(client)
            stream, kind = scope.get("answered", ("", "refused" if refusal else "other"))
            self._metrics.requests[stream, kind, status] += 1
            self._metrics.sent_bytes[stream] += sent

    def _refusal(self, scope: Scope, client: str) -> Response | None:
        """The answer to a request that is refused."""
        headers = Headers(scope=scope)
        if wait_seconds := self._buckets.wait_seconds(client):
            return self._refused("requests_per_second", 429, "This address asks too often.", wait_seconds)
        if scope["method"] not in METHODS:
            return self._refused("method", 405, "Only GET and HEAD are answered.")
        if "transfer-encoding" in headers or headers.get("content-length", "0") != "0":
            return self._refused("body", 413, "A request has no body here.")
        if len(scope["raw_path"]) > self._limits.path_bytes or len(scope["query_string"]) > self._limits.query_bytes:
            return self._refused("length", 414, "The address is too long.")
        if sum(len(name) + len(value) for name, value in scope["headers"]) > self._limits.header_bytes:
            return self._refused("header", 431, "The header is too long.")
        if not is_plain_path(scope["raw_path"]):
            return self._refused("path", 404, "There is nothing at this address.")
        return None

    def _refused(self, reason: str, status: int, text: str, wait_seconds: float = 0.0) -> Response:
        self._metrics.refused[reason] += 1
        headers = {**PASSING, "Connection": "close"} if status in (405, 413, 414, 431) else dict(PASSING)
        if status == 405:
            headers["Allow"] = ", ".join(METHODS)
        if wait_seconds:
            headers["Retry-After"] = str(max(round(wait_seconds + 0.5), 1))
        return PlainTextResponse(text, status, headers)

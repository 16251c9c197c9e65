# SPDX-License-Identifier: Apache-2.0
"""The real servers in a thread, for tests that talk to them through a socket."""

import http.client
import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import uvicorn

from structgstream.serve import app, play
from structgstream.serve.listening import bound, server
from structgstream.serve.pages import StreamFile


@dataclass(frozen=True)
class Answer:
    """What came back: status, headers in lower case, body."""

    status: int
    headers: dict[str, str]
    body: bytes

    @property
    def text(self) -> str:
        return self.body.decode()

    @property
    def json(self) -> Any:
        return json.loads(self.body)


@dataclass(frozen=True)
class Served:
    """A running server."""

    port: int

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.port}/"

    def connected(self) -> socket.socket:
        """A connection, for what no HTTP client would send."""
        return socket.create_connection(("127.0.0.1", self.port), timeout=20)

    def ask(self, path: str, *, method: str = "GET", **headers: str) -> Answer:
        """Asks for ``path``, just as it is written; headers with ``_`` for ``-``."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=20)
        try:
            connection.request(method, path, headers={name.replace("_", "-"): text for name, text in headers.items()})
            response = connection.getresponse()
            body = response.read()
            return Answer(response.status, {name.lower(): text for name, text in response.getheaders()}, body)
        finally:
            connection.close()


@contextmanager
def running(server: uvicorn.Server, listening: socket.socket) -> Iterator[Served]:
    """A server on a bound socket, which is closed afterwards."""
    with listening:
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]}, daemon=True)
        thread.start()
        try:
            yield Served(listening.getsockname()[1])
        finally:
            server.should_exit = True
            thread.join(20)
            assert not thread.is_alive()


@contextmanager
def hosted(settings: app.ServerSettings, *, clock: Callable[[], float] = time.time, **options: Any) -> Iterator[Served]:
    """The server of ``structgstream serve`` on a free port; options are those of ``server``."""
    with running(server(app.application(settings, clock=clock), **options), bound(0)) as found:
        yield found


@contextmanager
def served(stream: StreamFile, *, truth: play.Truth | None = None) -> Iterator[Served]:
    """The server of ``structgstream play`` on a free port."""
    with running(server(play.application(stream, truth=truth)), bound(0)) as found:
        yield found

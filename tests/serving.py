# SPDX-License-Identifier: Apache-2.0
"""The player's real server in a thread, for tests that talk to it through a socket."""

import http.client
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import uvicorn

from structgstream.player.running import bound
from structgstream.player.server import application
from structgstream.player.stream_file import StreamFile
from structgstream.player.truth import Truth


@dataclass(frozen=True)
class Answer:
    """What came back: status, headers in lower case, body."""

    status: int
    headers: dict[str, str]
    body: bytes


@dataclass(frozen=True)
class Served:
    """A running server."""

    port: int

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.port}/"

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
def served(stream: StreamFile, *, truth: Truth | None = None) -> Iterator[Served]:
    """The server of ``structgstream play`` on a free port."""
    with bound(0) as listening:
        server = uvicorn.Server(uvicorn.Config(application(stream, truth=truth), log_level="warning", access_log=False))
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]}, daemon=True)
        thread.start()
        try:
            yield Served(listening.getsockname()[1])
        finally:
            server.should_exit = True
            thread.join(20)
            assert not thread.is_alive()

# SPDX-License-Identifier: Apache-2.0
"""The real servers in a thread, and proxies in a process, for tests that talk to them through a socket."""

import getpass
import http.client
import json
import os
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import uvicorn

from structgstream.serve import app, play
from structgstream.serve.listening import bound, server
from structgstream.serve.pages import StreamFile
from tests.support.waiting import wait_until


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


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as found:
        return found.getsockname()[1]


@contextmanager
def started(command: list[str], port: int, folder: Path, **environment: str) -> Iterator[Served]:
    """A server in a process of its own, which listens on a port of the loopback address."""
    with (folder / "stderr").open("wb") as stderr:
        process = subprocess.Popen(command, env={**os.environ, **environment}, stderr=stderr)

    def is_up() -> bool:
        assert process.poll() is None, command
        with suppress(OSError):
            socket.create_connection(("127.0.0.1", port), 1).close()
            return True
        return False

    try:
        wait_until(is_up, seconds=30.0)
        yield Served(port)
    finally:
        process.terminate()
        process.wait(30.0)


@contextmanager
def nginx(folder: Path, port: int, site: str) -> Iterator[Served]:
    """nginx with what its block ``http`` has; its own files are in ``folder``."""
    user = f"user {getpass.getuser()};" if os.geteuid() == 0 else ""
    places = "".join(
        f"{kind}_temp_path {folder}/{kind};" for kind in ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
    )
    (folder / "nginx.conf").write_text(f"{user} daemon off; pid {folder}/pid; events {{}} http {{ {places}\n{site} }}")
    with started(["nginx", "-c", str(folder / "nginx.conf"), "-e", str(folder / "errors")], port, folder) as running:
        yield running

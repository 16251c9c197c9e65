# SPDX-License-Identifier: Apache-2.0
"""Where the bytes of cameras go that ``send.py`` plays: UDP, TCP, HTTP or RTSP on this machine."""

import socket
import threading
from collections.abc import Sequence
from typing import Protocol

from rtsp import RtspCamera

UDP_BYTES = 1316  # seven packets of MPEG-TS
HTTP_OK = b"HTTP/1.0 200 OK\r\nContent-Type: video/mp2t\r\n\r\n"


class Line(Protocol):
    """Where the bytes of a camera go."""

    def write(self, data: bytes, /) -> int: ...

    def close(self) -> None: ...


class Udp:
    """Datagrams to a port of this machine."""

    def __init__(self, port: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._address = ("127.0.0.1", port)

    def write(self, data: bytes) -> int:
        for start in range(0, len(data), UDP_BYTES):
            self._socket.sendto(data[start : start + UDP_BYTES], self._address)
        return len(data)

    def close(self) -> None:
        self._socket.close()


class Served:
    """Connections to a port of this machine, each of which gets what is written from then on.

    A new connection begins with a key frame, because a muxer begins anew whenever :attr:`fresh` is set.
    """

    def __init__(self, *, http: bool) -> None:
        self._http = http
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self._clients: list[socket.socket] = []
        self._lock = threading.Lock()
        self.fresh = threading.Event()
        threading.Thread(target=self._accept, daemon=True).start()

    def write(self, data: bytes) -> int:
        with self._lock:
            clients = [*self._clients]
        for client in clients:
            try:
                client.sendall(data)
            except OSError:
                self._drop(client)
        return len(data)

    def hang_up(self) -> None:
        """Closes the connections; new ones are taken."""
        with self._lock:
            clients, self._clients = self._clients, []
        for client in clients:
            client.close()

    def close(self) -> None:
        self._listener.close()
        self.hang_up()

    def _drop(self, client: socket.socket) -> None:
        with self._lock:
            if client in self._clients:
                self._clients.remove(client)
        client.close()

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._listener.accept()
                client.settimeout(2.0)
                if self._http:
                    client.recv(4096)
                    client.sendall(HTTP_OK)
            except OSError:
                if self._listener.fileno() < 0:
                    return
                continue
            with self._lock:
                self._clients.append(client)
            self.fresh.set()


def opened_lines(transport: str, names: Sequence[str]) -> tuple[dict[str, Line | RtspCamera], dict[str, str]]:
    """A line for each camera, and its address for a rig file."""
    lines: dict[str, Line | RtspCamera] = {}
    urls = {}
    for name in names:
        if transport == "rtsp":
            lines[name] = camera = RtspCamera()
            urls[name] = camera.url
        elif transport == "udp":
            port = free_port()
            lines[name], urls[name] = Udp(port), f"udp://127.0.0.1:{port}"
        else:
            lines[name] = served = Served(http=transport == "http")
            urls[name] = f"{transport}://127.0.0.1:{served.port}/"
    return lines, urls


def free_port() -> int:
    """A UDP port that is free now."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]

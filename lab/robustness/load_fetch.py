# SPDX-License-Identifier: Apache-2.0
"""Fetching files as fast as a server gives them, over connections that are kept."""

import getpass
import hashlib
import os
import socket
import statistics
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit


@dataclass(frozen=True)
class Fetched:
    """What came in some time: bytes of bodies, answers, and the SHA-256 of each file when it came first.

    ``busy_seconds`` are those of the server's process.
    """

    seconds: float
    bytes: int
    answers: int
    digests: Mapping[str, str]
    busy_seconds: float = 0.0


def fetched(address: str, names: Sequence[str], *, connections: int, seconds: float) -> Fetched:
    """Fetches the files over and over."""
    until = time.monotonic() + seconds
    digests: dict[str, str] = {}
    counts: list[tuple[int, int]] = []

    def run(first: int) -> None:
        counts.append(_fetch(address, [*names[first:], *names[:first]], until, digests))

    threads = [threading.Thread(target=run, args=(i % len(names),)) for i in range(connections)]
    began = time.monotonic()
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(counts) == connections, "every connection came to its end"
    taken = time.monotonic() - began
    return Fetched(taken, sum(size for size, _ in counts), sum(number for _, number in counts), digests)


def _fetch(address: str, names: Sequence[str], until: float, digests: dict[str, str]) -> tuple[int, int]:
    """Bytes and answers over one connection."""
    parts = urlsplit(address)
    buffer, size, answers = bytearray(2**20), 0, 0
    with socket.create_connection((parts.hostname, parts.port), timeout=60) as connection:
        while True:
            for name in names:
                if time.monotonic() >= until:
                    return size, answers
                request = f"GET {parts.path}{name} HTTP/1.1\r\nHost: {parts.hostname}\r\n\r\n"
                connection.sendall(request.encode())
                length, begun = _head(connection)
                digest = None if name in digests else hashlib.sha256(begun)
                left = length - len(begun)
                while left:
                    count = connection.recv_into(buffer, min(left, len(buffer)))
                    assert count, "the server closed the connection"
                    if digest is not None:
                        digest.update(memoryview(buffer)[:count])
                    left -= count
                if digest is not None:
                    digests[name] = digest.hexdigest()
                size, answers = size + length, answers + 1


def _head(connection: socket.socket) -> tuple[int, bytes]:
    """The length of an answer's body, and what of it came with the head."""
    data = b""
    while b"\r\n\r\n" not in data:
        piece = connection.recv(4096)
        assert piece, "the server closed the connection"
        data += piece
    head, _, begun = data.partition(b"\r\n\r\n")
    assert head.split(b" ", 2)[1] == b"200", head
    return int(head.lower().partition(b"content-length:")[2].partition(b"\r\n")[0]), begun


def rates(outcomes: Mapping[str, Sequence[Fetched]], folder: Path, names: Sequence[str]) -> dict[str, Any]:
    """MB/s and answers a second of each server, their medians over the turns, and ratios to ``serve`` turn by turn."""
    right = {name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in names}
    speeds = {server: [one.bytes / one.seconds / 1e6 for one in turns] for server, turns in outcomes.items()}
    return {
        "files": len(names),
        "mean_bytes": statistics.mean((folder / name).stat().st_size for name in names),
        "servers": {
            server: {
                "megabytes_per_second": statistics.median(speeds[server]),
                "answers_per_second": statistics.median(one.answers / one.seconds for one in turns),
                "busy_ms_an_answer": statistics.median(1000 * one.busy_seconds / one.answers for one in turns),
                "serve_is_times": statistics.median(
                    mine / theirs for mine, theirs in zip(speeds["serve"], speeds[server], strict=True)
                ),
                "exact": all(one.digests[name] == right[name] for one in turns for name in one.digests),
                "turns": speeds[server],
            }
            for server, turns in outcomes.items()
        },
    }


def free_port() -> int:
    """A port that was free a moment ago, for a program that cannot choose one itself."""
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return found.getsockname()[1]


def nginx_configuration(folder: Path, work: Path, port: int) -> str:
    """Of an nginx of one process that serves a folder, and keeps its files in ``work``."""
    places = "\n".join(
        f"    {kind}_temp_path {work}/nginx-{kind};" for kind in ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
    )
    user = f"user {getpass.getuser()};\n" if os.geteuid() == 0 else ""  # else another user could not read the folder
    return f"""{user}daemon off;
master_process off;
pid {work}/nginx.pid;
events {{ worker_connections 1024; }}
http {{
    access_log off;
    sendfile on;
    keepalive_requests 1000000;
{places}
    server {{
        listen 127.0.0.1:{port};
        root {folder};
    }}
}}
"""

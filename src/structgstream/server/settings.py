# SPDX-License-Identifier: Apache-2.0
"""What a server may be told."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from structgstream.server.tokens import TokenKeys

LOOPBACK_NAMES: Final = ("127.0.0.1", "localhost", "[::1]")

SAFE_HEADERS: Final[Mapping[str, str]] = {
    "Referrer-Policy": "no-referrer",  # The page's address may hold a token.
    "X-Content-Type-Options": "nosniff",
}
"""Headers of every answer."""

PASSING: Final[Mapping[str, str]] = {**SAFE_HEADERS, "Cache-Control": "no-store"}
"""Headers of answers that nobody keeps."""


@dataclass(frozen=True)
class Limits:
    """Bounds that keep one client from taking what others need.

    Args:
        requests_per_second: of an address, in the mean.
        burst: requests of an address at once.
        connections: of all addresses together.
        connections_per_address: connections of an address, and its requests at a time behind a proxy.
        addresses: whose requests are counted; the one that asked longest ago is forgotten first.
        waiters: requests that wait for a newer manifest; further ones get the present one.
        wait_seconds: how long one waits at most.
        header_seconds: within which a request's header has to be complete.
        stalled_seconds: after which a client that takes no bytes is disconnected.
        header_bytes: length of a header's names and values together.
        query_bytes: length of a query.
        path_bytes: length of a path.
    """

    requests_per_second: float = 50.0
    burst: int = 200
    connections: int = 1000
    connections_per_address: int = 100
    addresses: int = 10_000
    waiters: int = 1000
    wait_seconds: float = 25.0
    header_seconds: float = 10.0
    stalled_seconds: float = 60.0
    header_bytes: int = 16 * 1024
    query_bytes: int = 1024
    path_bytes: int = 512


@dataclass(frozen=True)
class ServerSettings:
    """One server.

    Args:
        folder: holds the streams, or is one.
        keys: what access tokens are checked with; None serves everyone.
        origins: whose pages may read, ``*`` for all; none: only pages of this server.
        hosts: names under which the server is asked; ``*`` for any.
        proxies: addresses or networks whose ``X-Forwarded-For`` and ``-Proto`` are believed.
        previews: whether preview pictures are rendered where no file has one.
        limits: bounds.
    """

    folder: Path
    keys: TokenKeys | None = None
    origins: tuple[str, ...] = ()
    hosts: tuple[str, ...] = LOOPBACK_NAMES
    proxies: tuple[str, ...] = ()
    previews: bool = True
    limits: Limits = Limits()

# SPDX-License-Identifier: Apache-2.0
"""Checks the network options of ``serve``, listens on an address, and runs an application on uvicorn."""

import ipaddress
import os
import socket
import webbrowser
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Final

import uvicorn
from starlette.types import ASGIApp

from structgstream.errors import ConfigError, PlayerError

LOOPBACK: Final = "127.0.0.1"
LOOPBACK_NAMES: Final = (LOOPBACK, "localhost", "[::1]")
KEEP_ALIVE_SECONDS: Final = 15
SHUTDOWN_SECONDS: Final = 2
MAX_HEADER_BYTES: Final = 16 * 1024
SEND_BUFFER_BYTES: Final = 256 * 1024
"""Send buffer of a connection in the kernel, which bounds the memory of a slow client."""


def checked_address(host: str, *, tokens: bool, public: bool) -> str:
    """The IP address to listen on. Raises ConfigError if it is none, or others could see the streams without a token
    and ``public`` is False."""
    try:
        address = ipaddress.ip_address(LOOPBACK if host == "localhost" else host)
    except ValueError:
        raise ConfigError(f"--host {host} is no IP address; expected one as 0.0.0.0, ::, or of this machine.") from None
    if not (address.is_loopback or tokens or public):
        raise ConfigError(
            f"--host {host} can be reached by others; give --secret-file, so that a token is needed, or --public, "
            "so that everyone may see all streams of the folder."
        )
    return str(address)


def accepted_hosts(address: str, names: tuple[str, ...]) -> tuple[str, ...]:
    """Host names that requests may have: this machine's, the address and ``names``; any for a public address without
    names."""
    if not names and not ipaddress.ip_address(address).is_loopback:
        return ("*",)
    return tuple(dict.fromkeys((*LOOPBACK_NAMES, _in_url(address), *(name.lower() for name in names))))


def _in_url(address: str) -> str:
    return f"[{address}]" if ":" in address else address


def checked_proxies(proxies: tuple[str, ...]) -> tuple[str, ...]:
    """Addresses or networks of proxies. Raises ConfigError if a text is neither."""
    for proxy in proxies:
        try:
            ipaddress.ip_network(proxy)
        except ValueError:
            raise ConfigError(f"--proxy {proxy} is no IP address or network, as 127.0.0.1 or 10.0.0.0/24.") from None
    return proxies


def checked_origins(origins: tuple[str, ...]) -> tuple[str, ...]:
    """Origins as a browser writes them. Raises ConfigError if a text is not an origin."""
    for origin in origins:
        scheme, separator, host = origin.partition("://")
        plain = host == host.lower() and not set(host) & set("/?#@* \\")
        if origin != "*" and not (scheme in ("http", "https") and separator and host and plain):
            raise ConfigError(f"--allow-origin {origin} is no origin; expected one as https://example.org, or *.")
    return origins


def bound(port: int, *, address: str = LOOPBACK) -> socket.socket:
    """A listening socket, which queues connections before the server runs. Raises PlayerError if the port is taken, or
    may not be used."""
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    # asyncio sets TCP_NODELAY only on a socket with this protocol; without it each further response waits 40 ms.
    listening = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    try:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)  # Connections inherit it.
        listening.bind((address, port))
        listening.listen()
    except (OSError, OverflowError) as error:
        listening.close()
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise PlayerError(
            f"Port {port} cannot be used ({reason}); choose another with --port, or leave it out."
        ) from None
    return listening


def server(app: ASGIApp, *, proxies: Sequence[str] = (), connections: int | None = None) -> uvicorn.Server:
    """A server, not yet running, that answers requests with 503 above this number of connections."""
    config = uvicorn.Config(
        app,
        http="h11",
        loop="asyncio",
        ws="none",
        lifespan="off",
        log_level="error",
        access_log=False,  # Queries may contain tokens.
        server_header=False,
        proxy_headers=bool(proxies),
        forwarded_allow_ips=list(proxies),
        limit_concurrency=None if connections is None else connections + 1,  # uvicorn refuses from its limit on
        h11_max_incomplete_event_size=MAX_HEADER_BYTES,
        timeout_keep_alive=KEEP_ALIVE_SECONDS,
        timeout_graceful_shutdown=SHUTDOWN_SECONDS,
    )
    return uvicorn.Server(config)


def run(server: uvicorn.Server, *, port: int, address: str = LOOPBACK, on_start: Callable[[str], None]) -> None:
    """Serve until Ctrl-C or SIGTERM; ``on_start`` is called with the server's address once the port is bound. Raises
    PlayerError if the port is taken, or may not be used."""
    with bound(port, address=address) as listening:
        on_start(f"http://{_in_url(address)}:{listening.getsockname()[1]}/")
        with suppress(KeyboardInterrupt):  # uvicorn shuts down on Ctrl-C and then raises it again.
            server.run(sockets=[listening])


def open_browser(address: str) -> bool:
    """Opens ``address``; returns False without a screen, because a text browser would use the terminal."""
    graphical = any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"))
    return graphical and webbrowser.open(address)

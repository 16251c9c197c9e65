# SPDX-License-Identifier: Apache-2.0
"""On which address a server may listen, and running it."""

import ipaddress
import socket
import time
from collections.abc import Callable
from contextlib import suppress

import uvicorn

from structgstream.errors import ConfigError
from structgstream.player.running import bound
from structgstream.server.app import application
from structgstream.server.metrics import Metrics
from structgstream.server.previews import Render, rendered_apart
from structgstream.server.protocol import Door, bounded_protocol
from structgstream.server.settings import LOOPBACK_NAMES, Limits, ServerSettings

KEEP_ALIVE_SECONDS = 15
SHUTDOWN_SECONDS = 2
SEND_BUFFER_BYTES = 256 * 1024
"""Of a connection, in the system: a slow client makes the system keep no more than about this."""


def checked_address(host: str, *, guarded: bool, public: bool) -> str:
    """The address to listen on.

    Args:
        host: an IP address of this machine, or ``localhost``.
        guarded: whether tokens are needed.
        public: whether the user said that everyone may see the streams.

    Raises:
        ConfigError: it is no address, or others could see the streams and nobody said that they may.
    """
    try:
        address = ipaddress.ip_address("127.0.0.1" if host == "localhost" else host)
    except ValueError:
        raise ConfigError(f"--host {host} is no IP address; expected one as 0.0.0.0, ::, or of this machine.") from None
    if not (address.is_loopback or guarded or public):
        raise ConfigError(
            f"--host {host} can be reached by others; give --secret-file, so that a token is needed, or --public, "
            "so that everyone may see all streams of the folder."
        )
    return str(address)


def accepted_hosts(address: str, names: tuple[str, ...]) -> tuple[str, ...]:
    """Under which names a server may be asked: this machine's and ``names``; any, if it is public without one."""
    if not names and not ipaddress.ip_address(address).is_loopback:
        return ("*",)
    return (*LOOPBACK_NAMES, *names)


def checked_proxies(proxies: tuple[str, ...]) -> tuple[str, ...]:
    """Addresses or networks of proxies.

    Raises:
        ConfigError: one is neither.
    """
    for proxy in proxies:
        try:
            ipaddress.ip_network(proxy)
        except ValueError:
            raise ConfigError(f"--proxy {proxy} is no IP address or network, as 127.0.0.1 or 10.0.0.0/24.") from None
    return proxies


def checked_origins(origins: tuple[str, ...]) -> tuple[str, ...]:
    """Origins as a browser writes them.

    Raises:
        ConfigError: one is none.
    """
    for origin in origins:
        scheme, separator, host = origin.partition("://")
        plain = host == host.lower() and not set(host) & set("/?#@* \\")
        if origin != "*" and not (scheme in ("http", "https") and separator and host and plain):
            raise ConfigError(f"--allow-origin {origin} is no origin; expected one as https://example.org, or *.")
    return origins


def checked_limits(requests_per_second: float, connections: int, connections_per_address: int) -> Limits:
    """The limits with these numbers; four seconds' worth of requests may come at once.

    Raises:
        ConfigError: one of them is not positive.
    """
    if not 0.0 < requests_per_second < 1e6:
        raise ConfigError(f"--requests-per-second {requests_per_second:g} is not above 0.")
    for option, number in (("connections", connections), ("connections-per-address", connections_per_address)):
        if not 1 <= number <= 100_000:
            raise ConfigError(f"--{option} {number} is not one of 1 to 100000.")
    return Limits(
        requests_per_second=requests_per_second,
        burst=max(round(4 * requests_per_second), 1),
        connections=connections,
        connections_per_address=connections_per_address,
        waiters=connections,
    )


def server(
    settings: ServerSettings, *, render: Render = rendered_apart, clock: Callable[[], float] = time.time
) -> uvicorn.Server:
    """A server, not yet running.

    Args:
        settings: what is served, and to whom.
        render: makes previews, unless the settings forbid it.
        clock: Unix seconds, which tokens expire by.

    Raises:
        PlayerError: the folder cannot be read, or the installation lacks the player.
    """
    metrics = Metrics()
    door = Door(settings.limits, metrics, proxies=settings.proxies)
    config = uvicorn.Config(
        application(settings, metrics=metrics, open_connections=lambda: door.connections, render=render, clock=clock),
        http=bounded_protocol(door),
        loop="asyncio",
        ws="none",
        lifespan="off",
        log_level="error",
        access_log=False,  # Queries may hold tokens.
        server_header=False,
        proxy_headers=bool(settings.proxies),
        forwarded_allow_ips=list(settings.proxies),
        h11_max_incomplete_event_size=settings.limits.header_bytes,
        timeout_keep_alive=KEEP_ALIVE_SECONDS,
        timeout_graceful_shutdown=SHUTDOWN_SECONDS,
    )
    return uvicorn.Server(config)


def listening_socket(address: str, port: int) -> socket.socket:
    """A bound socket, whose connections keep little for slow clients.

    Raises:
        PlayerError: the port is taken, or may not be used.
    """
    listening = bound(port, address=address)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)  # Connections inherit it.
    return listening


def run(settings: ServerSettings, *, address: str, port: int, on_start: Callable[[str], None]) -> None:
    """Serves until Ctrl-C or SIGTERM.

    Args:
        settings: what is served, and to whom.
        address: to listen on.
        port: 0 takes a free one.
        on_start: called with the server's address once the port is bound.

    Raises:
        PlayerError: the port cannot be used, the folder cannot be read, or the installation lacks the player.
    """
    prepared = server(settings)
    with listening_socket(address, port) as listening:
        name = f"[{address}]" if ":" in address else address
        on_start(f"http://{name}:{listening.getsockname()[1]}/")
        with suppress(KeyboardInterrupt):  # uvicorn shuts down on Ctrl-C and then raises it again.
            prepared.run(sockets=[listening])

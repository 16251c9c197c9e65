# SPDX-License-Identifier: Apache-2.0
"""Connections that cannot be held by doing nothing.

uvicorn bounds the size of a header and the time between requests. It waits for ever for the rest of a header, and for a
client that takes no bytes; here both have a time, and an address has a number of connections.
"""

import asyncio
import ipaddress
from collections.abc import Sequence
from typing import ClassVar

from uvicorn.protocols.http.h11_impl import H11Protocol

from structgstream.server.limits import Concurrent, client_key
from structgstream.server.metrics import Metrics
from structgstream.server.settings import Limits


class Door:
    """Admits connections, and closes those that take too long.

    Args:
        limits: their number and times.
        metrics: counts what is refused.
        proxies: addresses or networks, whose connections are those of many clients.
    """

    def __init__(self, limits: Limits, metrics: Metrics, *, proxies: Sequence[str] = ()) -> None:
        self.limits = limits
        self._metrics = metrics
        self._proxies = [ipaddress.ip_network(proxy) for proxy in proxies]
        self._open = Concurrent(limits.connections_per_address, most_together=limits.connections)
        self._from_proxies = Concurrent(limits.connections, most_together=limits.connections)

    @property
    def connections(self) -> int:
        """How many are open."""
        return self._open.total + self._from_proxies.total

    def enter(self, address: str) -> bool:
        """Counts a connection, unless that is too many."""
        if self.connections < self.limits.connections and self._counts(address).enter(client_key(address)):
            return True
        self._metrics.refused["connections"] += 1
        return False

    def leave(self, address: str) -> None:
        """Counts a connection that was admitted as closed."""
        self._counts(address).leave(client_key(address))

    def late(self, reason: str) -> None:
        """Counts a connection that is closed because it took too long."""
        self._metrics.refused[reason] += 1

    def _counts(self, address: str) -> Concurrent:
        try:
            found = ipaddress.ip_address(address)
        except ValueError:
            return self._open
        return self._from_proxies if any(found in network for network in self._proxies) else self._open


class BoundedConnection(H11Protocol):
    """A connection that ``door`` admitted; a class of its own for each server, made by :func:`bounded_protocol`."""

    door: ClassVar[Door]

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        if self.client is not None:  # On "::" an IPv4 address comes as ::ffff:192.0.2.1, which no --proxy would match.
            self.client = without_mapping(self.client[0]), self.client[1]
        self._address = self.client[0] if self.client else ""
        self._header_time: asyncio.TimerHandle | None = None
        self._stalled_time: asyncio.TimerHandle | None = None
        self._admitted = self.door.enter(self._address)
        if self._admitted:
            self._await_header()
        else:
            transport.abort()

    def data_received(self, data: bytes) -> None:
        if self._admitted:
            super().data_received(data)
            if self._answering():
                self._header_time = _ended(self._header_time)

    def on_response_complete(self) -> None:
        super().on_response_complete()
        if not self._answering() and not self.transport.is_closing():
            self._await_header()

    def pause_writing(self) -> None:
        super().pause_writing()
        seconds = self.door.limits.stalled_seconds
        self._stalled_time = self.loop.call_later(seconds, self._close_late, "stalled")

    def resume_writing(self) -> None:
        super().resume_writing()
        self._stalled_time = _ended(self._stalled_time)

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self._header_time = _ended(self._header_time)
        self._stalled_time = _ended(self._stalled_time)
        if self._admitted:
            self._admitted = False
            self.door.leave(self._address)

    def _answering(self) -> bool:
        return self.cycle is not None and not self.cycle.response_complete

    def _await_header(self) -> None:
        self._header_time = _ended(self._header_time)
        self._header_time = self.loop.call_later(self.door.limits.header_seconds, self._close_late, "slow_header")

    def _close_late(self, reason: str) -> None:
        self.door.late(reason)
        self.transport.abort()


def without_mapping(address: str) -> str:
    """The IPv4 address in an IPv6 one that stands for it; any other text as it is."""
    try:
        found = ipaddress.ip_address(address)
    except ValueError:
        return address
    mapped = found.ipv4_mapped if isinstance(found, ipaddress.IPv6Address) else None
    return address if mapped is None else str(mapped)


def _ended(timer: asyncio.TimerHandle | None) -> None:
    if timer is not None:
        timer.cancel()


def bounded_protocol(door: Door) -> type[BoundedConnection]:
    """The class of a server's connections, for uvicorn."""
    return type("ServedConnection", (BoundedConnection,), {"door": door})

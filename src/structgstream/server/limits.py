# SPDX-License-Identifier: Apache-2.0
"""Counting what an address does: requests a second, requests and connections at a time."""

import ipaddress
import time
from collections import Counter, OrderedDict
from collections.abc import Callable


def client_key(address: str) -> str:
    """What counts as one client: an IPv4 address, or the 64 bits of an IPv6 network, which one client may use whole."""
    try:
        found = ipaddress.ip_address(address)
    except ValueError:
        return address[:64]
    if isinstance(found, ipaddress.IPv6Address):
        if found.ipv4_mapped is not None:
            return str(found.ipv4_mapped)
        return str(ipaddress.ip_network((int(found) >> 64 << 64, 64)))
    return str(found)


class TokenBuckets:
    """A bucket a client, which each request takes one from and time fills again.

    Args:
        per_second: by which a bucket is filled.
        burst: what a full one holds.
        most: number of clients; the one that asked longest ago is forgotten first.
        clock: seconds that rise.
    """

    def __init__(
        self, per_second: float, burst: int, *, most: int, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._per_second = per_second
        self._burst = burst
        self._most = most
        self._clock = clock
        self._buckets: OrderedDict[str, tuple[float, float]] = OrderedDict()  # what is in it, when that was

    def __len__(self) -> int:
        return len(self._buckets)

    def wait_seconds(self, client: str) -> float:
        """Takes one from the client's bucket: 0. From an empty one nothing is taken: the seconds until there is one."""
        now = self._clock()
        level, then = self._buckets.get(client, (float(self._burst), now))
        level = min(level + (now - then) * self._per_second, self._burst)
        granted = level >= 1.0
        self._buckets[client] = level - 1.0 if granted else level, now
        self._buckets.move_to_end(client)
        while len(self._buckets) > self._most:
            self._buckets.popitem(last=False)
        return 0.0 if granted else (1.0 - level) / self._per_second


class Concurrent:
    """How many of something each client has now.

    Args:
        most: of one client.
        most_together: of all clients together.
    """

    def __init__(self, most: int, *, most_together: int) -> None:
        self._most = most
        self._most_together = most_together
        self._counts: Counter[str] = Counter()
        self.total = 0

    def enter(self, client: str) -> bool:
        """Counts one more, unless that is too many."""
        if self.total >= self._most_together or self._counts.get(client, 0) >= self._most:
            return False
        self._counts[client] += 1
        self.total += 1
        return True

    def leave(self, client: str) -> None:
        """Counts one less."""
        self.total -= 1
        self._counts[client] -= 1
        if not self._counts[client]:
            del self._counts[client]

# SPDX-License-Identifier: Apache-2.0
"""Connections, and how many there may be."""

from pathlib import Path

import pytest

from serving import Answer, running
from structgstream.server.listening import listening_socket, server
from structgstream.server.metrics import Metrics
from structgstream.server.protocol import Door, bounded_protocol, without_mapping
from structgstream.server.settings import Limits, ServerSettings


def test_an_address_has_so_many_connections() -> None:
    metrics = Metrics()
    door = Door(Limits(connections=5, connections_per_address=2), metrics)
    assert [door.enter("192.0.2.1") for _ in range(3)] == [True, True, False]
    assert [door.enter("2001:db8::1"), door.enter("2001:db8::2"), door.enter("2001:db8::3")] == [True, True, False]
    assert (door.connections, metrics.refused["connections"]) == (4, 2)
    door.leave("192.0.2.1")
    assert door.enter("192.0.2.1")


def test_all_addresses_together_have_so_many() -> None:
    door = Door(Limits(connections=2, connections_per_address=2), Metrics(), proxies=("10.0.0.0/24",))
    assert [door.enter("192.0.2.1"), door.enter("10.0.0.1"), door.enter("192.0.2.2")] == [True, True, False]
    assert not door.enter("10.0.0.1")
    door.leave("10.0.0.1")
    assert door.enter("192.0.2.2")
    assert door.connections == 2


def test_a_proxy_holds_the_connections_of_many() -> None:
    door = Door(Limits(connections=9, connections_per_address=1), Metrics(), proxies=("10.0.0.0/24", "2001:db8::/32"))
    assert [door.enter("10.0.0.7") for _ in range(3)] == [True] * 3
    assert [door.enter("2001:db8::7") for _ in range(3)] == [True] * 3
    assert [door.enter("10.0.1.7"), door.enter("10.0.1.7")] == [True, False]


def test_what_is_no_address_is_one_client() -> None:
    door = Door(Limits(connections_per_address=1), Metrics(), proxies=("10.0.0.0/24",))
    assert [door.enter(""), door.enter("")] == [True, False]
    door.leave("")
    assert door.connections == 0


def test_who_takes_too_long_is_counted() -> None:
    metrics = Metrics()
    Door(Limits(), metrics).late("stalled")
    assert metrics.refused == {"stalled": 1}


def test_each_server_has_a_door_of_its_own() -> None:
    doors = [Door(Limits(), Metrics()) for _ in range(2)]
    one, other = (bounded_protocol(door) for door in doors)
    assert (one.door, other.door) == (doors[0], doors[1])


@pytest.mark.parametrize(
    ("given", "plain"),
    [
        ("::ffff:192.0.2.1", "192.0.2.1"),
        ("::FFFF:c000:0201", "192.0.2.1"),
        ("192.0.2.1", "192.0.2.1"),
        ("2001:db8::1", "2001:db8::1"),
        ("fe80::1%eth0", "fe80::1%eth0"),
        ("", ""),
        ("unix", "unix"),
    ],
)
def test_an_address_in_another(given: str, plain: str) -> None:
    assert without_mapping(given) == plain


@pytest.mark.parametrize("host", ["0.0.0.0", "::"])
def test_a_proxy_is_known_however_the_system_writes_its_address(tmp_path: Path, host: str) -> None:
    """On ``::`` the system gives IPv4 addresses as IPv6 ones; the clients behind the proxy are told apart even so."""
    limits = Limits(requests_per_second=0.001, burst=1, connections_per_address=1)
    settings = ServerSettings(tmp_path, previews=False, hosts=("*",), proxies=("127.0.0.1",), limits=limits)
    try:
        listening = listening_socket(host, 0)
    except OSError:
        pytest.skip("this machine has no IPv6")
    with running(server(settings), listening) as found:

        def ask(client: str) -> Answer:
            return found.ask("/health", X_Forwarded_For=client)

        assert [ask(client).status for client in ("203.0.113.1", "203.0.113.2", "203.0.113.1")] == [200, 200, 429]
        with found.connected(), found.connected():
            assert ask("203.0.113.3").status == 200

# SPDX-License-Identifier: Apache-2.0
"""On which addresses a server listens, and what it is told."""

import socket

import pytest

from structgstream.errors import ConfigError
from structgstream.server.listening import (
    accepted_hosts,
    checked_address,
    checked_limits,
    checked_origins,
    checked_proxies,
    listening_socket,
)
from structgstream.server.settings import LOOPBACK_NAMES


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.53", "::1", "localhost"])
def test_the_loopback_address_needs_no_word(host: str) -> None:
    checked_address(host, guarded=False, public=False)


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.0.2.1", "2001:db8::1", "::ffff:192.0.2.1", "169.254.1.1"])
def test_other_addresses_need_a_token_or_a_word(host: str) -> None:
    with pytest.raises(ConfigError, match="give --secret-file, .* or --public"):
        checked_address(host, guarded=False, public=False)
    assert checked_address(host, guarded=True, public=False) == checked_address(host, guarded=False, public=True)


@pytest.mark.parametrize("host", ["", "example.org", "0", "127.1", "localhost.", "127.0.0.1:80", "0x7f000001"])
def test_names_are_no_addresses(host: str) -> None:
    with pytest.raises(ConfigError, match="is no IP address"):
        checked_address(host, guarded=True, public=True)


def test_the_names_of_a_server() -> None:
    assert accepted_hosts("127.0.0.1", ()) == LOOPBACK_NAMES
    assert accepted_hosts("127.0.0.1", ("live.example.org",)) == (*LOOPBACK_NAMES, "live.example.org")
    assert accepted_hosts("192.0.2.1", ()) == ("*",)
    assert accepted_hosts("192.0.2.1", ("live.example.org",)) == (*LOOPBACK_NAMES, "live.example.org")


@pytest.mark.parametrize(
    "origin", ["example.org", "https://", "https://a/b", "https://*.a", "ftp://a", "http://u@a", ""]
)
def test_what_is_no_origin(origin: str) -> None:
    with pytest.raises(ConfigError, match="is no origin"):
        checked_origins((origin,))


def test_origins_and_proxies() -> None:
    assert checked_origins(("https://a.example", "http://localhost:8000", "*"))
    assert checked_proxies(("127.0.0.1", "10.0.0.0/24", "::1"))
    for proxy in ("proxy.example.org", "10.0.0.1/24", "*", ""):
        with pytest.raises(ConfigError, match="is no IP address or network"):
            checked_proxies((proxy,))


def test_limits_are_positive() -> None:
    assert checked_limits(0.5, 10, 2).burst == 2
    for numbers in ((0.0, 1, 1), (float("nan"), 1, 1), (float("inf"), 1, 1), (1.0, 0, 1), (1.0, 1, -1)):
        with pytest.raises(ConfigError):
            checked_limits(*numbers)


@pytest.mark.parametrize("address", ["127.0.0.1", "::1"])
def test_a_connection_keeps_little_for_a_slow_client(address: str) -> None:
    if address == "::1" and not socket.has_ipv6:
        pytest.skip("there is no IPv6 here")
    with listening_socket(address, 0) as listening, socket.create_connection(listening.getsockname()[:2], 5):
        accepted, _ = listening.accept()
        with accepted:
            assert accepted.getsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF) <= 2**20

# SPDX-License-Identifier: Apache-2.0
"""Addresses, options, and sockets of a server."""

import asyncio
import os
import socket
import webbrowser

import pytest

from structgstream.errors import ConfigError, PlayerError
from structgstream.serve.listening import (
    LOOPBACK_NAMES,
    accepted_hosts,
    bound,
    checked_address,
    checked_origins,
    checked_proxies,
    open_browser,
)


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.53", "::1", "localhost"])
def test_the_loopback_address_needs_no_word(host: str) -> None:
    checked_address(host, tokens=False, public=False)


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.0.2.1", "2001:db8::1", "::ffff:192.0.2.1", "169.254.1.1"])
def test_other_addresses_need_a_token_or_a_word(host: str) -> None:
    with pytest.raises(ConfigError, match="give --secret-file, .* or --public"):
        checked_address(host, tokens=False, public=False)
    assert checked_address(host, tokens=True, public=False) == checked_address(host, tokens=False, public=True)


@pytest.mark.parametrize("host", ["", "example.org", "0", "127.1", "localhost.", "127.0.0.1:80", "0x7f000001"])
def test_names_are_no_addresses(host: str) -> None:
    with pytest.raises(ConfigError, match="is no IP address"):
        checked_address(host, tokens=True, public=True)


def test_the_names_of_a_server() -> None:
    assert accepted_hosts("127.0.0.1", ()) == LOOPBACK_NAMES
    assert accepted_hosts("127.0.0.1", ("live.example.org",)) == (*LOOPBACK_NAMES, "live.example.org")
    assert accepted_hosts("192.0.2.1", ()) == ("*",)
    assert accepted_hosts("127.0.0.2", ()) == (*LOOPBACK_NAMES, "127.0.0.2")
    assert accepted_hosts("::1", ()) == LOOPBACK_NAMES
    assert accepted_hosts("192.0.2.1", ("Live.example.org",)) == (*LOOPBACK_NAMES, "192.0.2.1", "live.example.org")
    assert accepted_hosts("2001:db8::1", ("a",)) == (*LOOPBACK_NAMES, "[2001:db8::1]", "a")


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


@pytest.mark.parametrize("address", ["127.0.0.1", "::1"])
def test_a_connection_keeps_little_for_a_slow_client(address: str) -> None:
    if address == "::1" and not socket.has_ipv6:
        pytest.skip("there is no IPv6 here")
    with bound(0, address=address) as listening, socket.create_connection(listening.getsockname()[:2], 5):
        accepted, _ = listening.accept()
        with accepted:
            assert accepted.getsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF) <= 2**20


def test_responses_of_a_connection_are_not_delayed() -> None:
    """asyncio sets TCP_NODELAY only where the socket says that it is TCP."""
    accepted = asyncio.Event()
    delays: list[int] = []

    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        delays.append(writer.get_extra_info("socket").getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY))
        accepted.set()
        writer.close()

    async def serve() -> None:
        with bound(0) as listening:
            async with await asyncio.start_server(answer, sock=listening):
                _, writer = await asyncio.open_connection(*listening.getsockname())
                await asyncio.wait_for(accepted.wait(), 10)
                writer.close()

    asyncio.run(serve())
    assert delays == [1]


@pytest.mark.parametrize("port", [-1, 65536, "taken"])
def test_a_port_that_cannot_be_used_is_one_sentence(port: int | str) -> None:
    with bound(0) as listening:
        number = listening.getsockname()[1] if isinstance(port, str) else port
        with pytest.raises(PlayerError, match=rf"Port {number} cannot be used \(.+\); choose another with --port"):
            bound(number)


def test_a_browser_needs_a_screen(monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", lambda address: opened.append(address) or True)
    for environ in ({}, {"DISPLAY": "", "TERM": "xterm"}):
        monkeypatch.setattr(os, "environ", environ)
        assert not open_browser("http://here/")
    assert not opened
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"):
        monkeypatch.setattr(os, "environ", {name: ":0"})
        assert open_browser("http://here/")
    assert opened == ["http://here/"] * 3

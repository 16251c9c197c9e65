# SPDX-License-Identifier: Apache-2.0
"""A port is ours before anything is told of it, and a browser opens where there is a screen."""

import asyncio
import socket
import webbrowser

import pytest

from structgstream.errors import PlayerError
from structgstream.player.running import ADDRESS, bound, open_browser


def test_a_connection_is_accepted_before_the_server_runs() -> None:
    with bound(0) as listening, socket.create_connection((ADDRESS, listening.getsockname()[1]), timeout=5) as client:
        assert client.getpeername()[0] == ADDRESS
        assert listening.getsockname()[0] == ADDRESS


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
    assert not open_browser("http://here/", environ={})
    assert not open_browser("http://here/", environ={"DISPLAY": "", "TERM": "xterm"})
    assert not opened
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"):
        assert open_browser("http://here/", environ={name: ":0"})
    assert opened == ["http://here/"] * 3

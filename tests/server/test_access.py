# SPDX-License-Identifier: Apache-2.0
"""Who may see what."""

import asyncio
from pathlib import Path

import pytest
from starlette.requests import Request

from structgstream.server.access import Gate, Refused, query_of
from structgstream.server.catalog import Catalog
from structgstream.server.streams import Streams
from structgstream.server.tokens import EVERY_STREAM, TokenKeys

KEYS = TokenKeys((b"k" * 32,))
NOW = 1000.0


@pytest.fixture
def streams(tmp_path: Path) -> Streams:
    """Two streams."""
    for name in ("ball.sgs", "show.sgs"):
        (tmp_path / name).touch()
    return Streams(Catalog(tmp_path), render=None)


def request(name: str = "", *, query: str = "", bearer: str | None = None) -> Request:
    headers = [] if bearer is None else [(b"authorization", f"Bearer {bearer}".encode())]
    scope = {"type": "http", "headers": headers, "query_string": query.encode(), "path_params": {"name": name}}
    return Request(scope)


def token(stream: str, *, expires: int = 2000) -> str:
    return KEYS.token(stream, expires_unix_seconds=expires)


def gate(streams: Streams, *, keys: TokenKeys | None = KEYS) -> Gate:
    return Gate(keys, streams, clock=lambda: NOW)


def refused(gate: Gate, name: str, asked: Request) -> Refused:
    with pytest.raises(Refused) as found:
        gate.check(asked, name)
    return found.value


def test_a_token_opens_its_stream(streams: Streams) -> None:
    own = token("ball.sgs")
    assert gate(streams).check(request(query=f"token={own}&after=3"), "ball.sgs").after == 3
    assert gate(streams).check(request(bearer=own), "ball.sgs").token == own
    assert gate(streams).check(request(bearer=token(EVERY_STREAM)), "show.sgs")


@pytest.mark.parametrize(
    ("query", "status", "said"),
    [
        ("", 401, "is needed here"),
        ("token=", 401, "is needed here"),
        ("token=v1.2.3.4", 401, "not one of this server"),
        (f"token={token('ball.sgs', expires=1000)}", 401, "has expired"),
        (f"token={token('show.sgs')}", 403, "for another stream"),
        ("token=a&token=b", 400, "twice"),
    ],
)
def test_others_do_not(streams: Streams, query: str, status: int, said: str) -> None:
    found = refused(gate(streams), "ball.sgs", request(query=query))
    assert (found.status, said in found.text) == (status, True)
    assert ("WWW-Authenticate" in found.headers) == (status == 401)


def test_without_keys_everyone_may(streams: Streams) -> None:
    open_gate = gate(streams, keys=None)
    assert open_gate.check(request(), "ball.sgs").token is None
    assert len(asyncio.run(open_gate.visible(request()))) == 2
    assert open_gate.passed_on(request(query="token=whatever")) == ""


def test_the_stream_that_an_address_names(streams: Streams) -> None:
    own = token("ball.sgs")
    assert asyncio.run(gate(streams).stream(request("ball.sgs", bearer=own))).name == "ball.sgs"
    for name in ("none.sgs", "..", ""):
        with pytest.raises(Refused, match="nothing at this address") as found:
            asyncio.run(gate(streams).stream(request(name, bearer=token(EVERY_STREAM))))
        assert found.value.status == 404


def test_who_has_no_token_is_not_told_which_streams_there_are(streams: Streams) -> None:
    for name in ("ball.sgs", "none.sgs"):
        with pytest.raises(Refused) as found:
            asyncio.run(gate(streams).stream(request(name)))
        assert (found.value.status, found.value.text) == (401, "An access token is needed here.")


def test_the_list_holds_what_the_token_opens(streams: Streams) -> None:
    def visible(bearer: str | None) -> list[str]:
        return [one.name for one in asyncio.run(gate(streams).visible(request(bearer=bearer)))]

    assert visible(token(EVERY_STREAM)) == ["ball.sgs", "show.sgs"]
    assert visible(token("show.sgs")) == ["show.sgs"]
    assert visible(token("later.sgs")) == []
    for bearer in (None, "v1.2.3.4", token("show.sgs", expires=999)):
        with pytest.raises(Refused) as found:
            visible(bearer)
        assert found.value.status == 401


def test_a_page_passes_its_token_on(streams: Streams) -> None:
    assert gate(streams).passed_on(request(query="token=abc")) == "?token=abc"
    assert gate(streams).passed_on(request(bearer="abc")) == "?token=abc"
    assert gate(streams).passed_on(request()) == ""


def test_a_malformed_query_is_refused() -> None:
    with pytest.raises(Refused, match="not a sequence number") as found:
        query_of(request(query="after=x"))
    assert found.value.status == 400

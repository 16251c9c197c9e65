# SPDX-License-Identifier: Apache-2.0
"""Whether the token of a request gives access."""

import pytest
from starlette.requests import Request

from structgstream.serve.access import EVERY_STREAM, Access, Authorizer, Refused, TokenKeys, token_of

KEYS = TokenKeys((b"k" * 32,))
NOW = 1000.0


def request(*, query: str = "", bearer: str | None = None) -> Request:
    headers = [] if bearer is None else [(b"authorization", f"Bearer {bearer}".encode())]
    return Request({"type": "http", "headers": headers, "query_string": query.encode()})


def token(stream: str, *, expires: int = 2000) -> str:
    return KEYS.token(stream, expires_unix_seconds=expires)


def authorizer(keys: TokenKeys | None = KEYS) -> Authorizer:
    return Authorizer(keys, clock=lambda: NOW)


def test_a_token_gives_access_to_its_stream() -> None:
    own = token("ball.sgs")
    authorizer().check(request(query=f"token={own}&after=3"), "ball.sgs")
    authorizer().check(request(bearer=own), "ball.sgs")
    authorizer().check(request(bearer=token(EVERY_STREAM)), "show.sgs")


@pytest.mark.parametrize(
    ("query", "status", "text"),
    [
        ("", 401, "is needed here"),
        ("token=", 401, "is needed here"),
        ("token=v1.2.3.4", 401, "not one of this server"),
        (f"token={token('ball.sgs', expires=1000)}", 401, "has expired"),
        (f"token={token('show.sgs')}", 403, "for another stream"),
    ],
)
def test_other_tokens_do_not(query: str, status: int, text: str) -> None:
    with pytest.raises(Refused) as found:
        authorizer().check(request(query=query), "ball.sgs")
    assert (found.value.status, text in found.value.text) == (status, True)
    assert ("WWW-Authenticate" in found.value.headers) == (status == 401)


def test_without_keys_everyone_has_access() -> None:
    assert authorizer(None).access(request(), "ball.sgs") is Access.GRANTED
    assert authorizer(None).page_query(request(query="token=whatever")) == ""


def test_a_page_passes_its_token_on() -> None:
    assert authorizer().page_query(request(query="token=abc")) == "?token=abc"
    assert authorizer().page_query(request(bearer="abc")) == "?token=abc"
    assert authorizer().page_query(request()) == ""


def test_the_header_comes_before_the_query() -> None:
    def found(authorization: str) -> str | None:
        headers = [(b"authorization", authorization.encode())]
        return token_of(Request({"type": "http", "headers": headers, "query_string": b"token=one"}))

    assert found("Bearer two.~+/-_==") == "two.~+/-_=="
    assert found("bEARER   two") == "two"
    for other in ("Basic two", "Bearer", "Bearer two three", "Bearer two\n", "Bearer =", "Bearertwo"):
        assert found(other) == "one", other

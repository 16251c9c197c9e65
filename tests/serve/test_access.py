# SPDX-License-Identifier: Apache-2.0
"""Queries, and whether a token gives access."""

from urllib.parse import urlencode

import pytest
from hypothesis import given
from hypothesis import strategies as st
from starlette.requests import Request

from structgstream.serve.access import (
    EVERY_STREAM,
    MAX_PARAMETERS,
    Access,
    Authorizer,
    Query,
    Refused,
    TokenKeys,
    parsed_query,
    query_of,
)
from tests.support.properties import examples

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
        ("token=a&token=b", 400, "twice"),
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


def test_a_malformed_query_is_refused() -> None:
    with pytest.raises(Refused, match="not a sequence number") as found:
        query_of(request(query="after=x"))
    assert found.value.status == 400


def test_token_and_sequence() -> None:
    assert parsed_query(b"", {}) == Query(None, None)
    assert parsed_query(b"after=7&token=abc&other=x", {}) == Query("abc", 7)
    assert parsed_query(b"after=0", {}) == Query(None, 0)
    assert parsed_query(b"token=", {}) == Query("", None)


def test_the_header_comes_before_the_query() -> None:
    assert parsed_query(b"token=one", {"authorization": "Bearer two.~+/-_=="}).token == "two.~+/-_=="
    assert parsed_query(b"token=one", {"authorization": "bEARER   two"}).token == "two"
    for other in ("Basic two", "Bearer", "Bearer two three", "Bearer two\n", "Bearer =", "Bearertwo"):
        assert parsed_query(b"token=one", {"authorization": other}).token == "one", other


@pytest.mark.parametrize("raw", [b"token=a&token=a", b"after=1&after=2", b"after=1&%61fter=2"])
def test_what_is_said_twice_is_refused(raw: bytes) -> None:
    with pytest.raises(Refused, match="twice"):
        parsed_query(raw, {})


@pytest.mark.parametrize("value", ["", "-1", "1.0", "1e3", "x", "%31%0a", "+1", "1_0", "9" * 17, "%D9%A1"])
def test_what_is_no_sequence_number(value: str) -> None:
    with pytest.raises(Refused, match="not a sequence number"):
        parsed_query(f"after={value}".encode(), {})


@pytest.mark.parametrize("raw", [b"a=%ff", b"\xff", b"a=%c3%28"])
def test_what_cannot_be_read_is_refused(raw: bytes) -> None:
    with pytest.raises(Refused, match="cannot be read"):
        parsed_query(raw, {})


def test_parameters_are_counted() -> None:
    assert parsed_query(b"&".join([b"a=1"] * MAX_PARAMETERS), {}) == Query(None, None)
    with pytest.raises(Refused, match=f"more than {MAX_PARAMETERS} parameters"):
        parsed_query(b"&".join([b"a=1"] * (MAX_PARAMETERS + 1)), {})


@given(st.text(max_size=30), st.integers(0, 10**16 - 1))
@examples(200)
def test_what_a_client_writes_is_what_is_read(token: str, after: int) -> None:
    if not token.isprintable() and any("\ud800" <= c <= "\udfff" for c in token):
        return
    assert parsed_query(urlencode({"token": token, "after": after}).encode(), {}) == Query(token, after)


@given(st.binary(max_size=60), st.text(max_size=40))
@examples(600)
def test_nothing_but_a_query_or_a_sentence_comes_out(raw: bytes, authorization: str) -> None:
    try:
        found = parsed_query(raw, {"authorization": authorization})
    except Refused:
        return
    assert found.after is None or 0 <= found.after < 10**16

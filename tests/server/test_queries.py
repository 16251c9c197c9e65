# SPDX-License-Identifier: Apache-2.0
"""What a request says besides its path."""

from urllib.parse import urlencode

import pytest
from hypothesis import given
from hypothesis import strategies as st

from properties import examples
from structgstream.server.queries import MOST_PARAMETERS, BadQuery, Query, accepts_gzip, knows, parsed_query


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
    with pytest.raises(BadQuery, match="twice"):
        parsed_query(raw, {})


@pytest.mark.parametrize("value", ["", "-1", "1.0", "1e3", "x", "%31%0a", "+1", "1_0", "9" * 17, "%D9%A1"])
def test_what_is_no_sequence_number(value: str) -> None:
    with pytest.raises(BadQuery, match="not a sequence number"):
        parsed_query(f"after={value}".encode(), {})


@pytest.mark.parametrize("raw", [b"a=%ff", b"\xff", b"a=%c3%28"])
def test_what_cannot_be_read_is_refused(raw: bytes) -> None:
    with pytest.raises(BadQuery, match="cannot be read"):
        parsed_query(raw, {})


def test_parameters_are_counted() -> None:
    assert parsed_query(b"&".join([b"a=1"] * MOST_PARAMETERS), {}) == Query(None, None)
    with pytest.raises(BadQuery, match=f"more than {MOST_PARAMETERS} parameters"):
        parsed_query(b"&".join([b"a=1"] * (MOST_PARAMETERS + 1)), {})


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
    except BadQuery:
        return
    assert found.after is None or 0 <= found.after < 10**16


def test_validators() -> None:
    assert knows({"if-none-match": '"a"'}, '"a"')
    assert knows({"if-none-match": '"b", W/"a"'}, '"a"', '"c"')
    assert knows({"if-none-match": " * "}, '"a"')
    assert not knows({"if-none-match": '"b"'}, '"a"')
    assert not knows({"if-none-match": "a"}, '"a"')
    assert not knows({"if-none-match": ""}, '"a"')
    assert not knows({}, '"a"')


@pytest.mark.parametrize("given", ["gzip", "br, gzip", "GZIP", "deflate;q=1, gzip;q=0.5", "gzip ; q=0.001", "gzip;q=1"])
def test_who_takes_gzip(given: str) -> None:
    assert accepts_gzip({"accept-encoding": given})


@pytest.mark.parametrize("given", ["", "br", "gzip;q=0", "gzip;q=0.0", "gzip; Q=0.000", "identity", "x-gzip", "*"])
def test_who_does_not(given: str) -> None:
    assert not accepts_gzip({"accept-encoding": given})


def test_who_does_not_say() -> None:
    assert not accepts_gzip({})

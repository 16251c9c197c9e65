# SPDX-License-Identifier: Apache-2.0
"""Access tokens: what they open, until when, and what a forger tries."""

import base64
import hmac
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from starlette.requests import Request

from structgstream.errors import ConfigError
from structgstream.serve import access as tokens
from structgstream.serve.access import EVERY_STREAM, Access, TokenKeys, read_keys, token_of
from structgstream.serve.app import ServerSettings
from tests.support.segment_folders import GrowingFolder
from tests.support.serving import Served, hosted
from tests.support.streams import small_stream

STREAM = small_stream(4)
KEYS = TokenKeys((b"a secret of thirty-two characters",))
NOW = 1_700_000_000.0
TOKEN = KEYS.token("studio", expires_unix_seconds=int(NOW) + 60)


def test_a_token_opens_its_stream_until_it_expires() -> None:
    assert KEYS.access(TOKEN, "studio", unix_seconds=NOW) is Access.GRANTED
    assert KEYS.access(TOKEN, "studio", unix_seconds=NOW + 59.9) is Access.GRANTED
    assert KEYS.access(TOKEN, "studio", unix_seconds=NOW + 60.0) is Access.EXPIRED
    assert KEYS.access(TOKEN, "studi", unix_seconds=NOW) is Access.OTHER_STREAM
    assert KEYS.access(None, "studio", unix_seconds=NOW) is Access.MISSING
    assert KEYS.access("", "studio", unix_seconds=NOW) is Access.MISSING


def test_one_token_opens_every_stream() -> None:
    every = KEYS.token(EVERY_STREAM, expires_unix_seconds=int(NOW) + 60)
    for name in ("studio", "ball.sgs", EVERY_STREAM):
        assert KEYS.access(every, name, unix_seconds=NOW) is Access.GRANTED
    assert KEYS.access(TOKEN, EVERY_STREAM, unix_seconds=NOW) is Access.OTHER_STREAM


def test_the_signature_is_the_documented_one() -> None:
    _, expires, signature, name = TOKEN.split(".", 3)
    content = b"structgstream access token v1\0" + f"{expires}\0{name}".encode()
    digest = hmac.digest(KEYS.secrets[0], content, "sha256")
    assert signature == base64.urlsafe_b64encode(digest).decode().rstrip("=")


@given(st.integers(0, len(TOKEN) - 1), st.characters(max_codepoint=0x2FF))
def test_a_token_with_another_character_opens_nothing(place: int, character: str) -> None:
    forged = TOKEN[:place] + character + TOKEN[place + 1 :]
    if forged != TOKEN:
        # The last digit of a signature has two bits that mean nothing; the text is compared, so they count too.
        assert KEYS.access(forged, "studio", unix_seconds=NOW) is Access.FORGED


def test_parts_of_two_tokens_open_nothing() -> None:
    first, other = TOKEN.split(".", 3), KEYS.token("ball.sgs", expires_unix_seconds=int(NOW) + 9999).split(".", 3)
    for place in range(1, 4):
        mixed = ".".join([*first[:place], other[place], *first[place + 1 :]])
        for name in ("studio", "ball.sgs"):
            assert KEYS.access(mixed, name, unix_seconds=NOW) is Access.FORGED
    stranger = TokenKeys((b"another secret of thirty-two characters",))
    assert stranger.access(TOKEN, "studio", unix_seconds=NOW) is Access.FORGED


def test_signatures_are_compared_in_constant_time(monkeypatch: pytest.MonkeyPatch) -> None:
    compared: list[tuple[bytes, bytes]] = []
    in_constant_time = hmac.compare_digest

    def compare(a: bytes, b: bytes) -> bool:
        compared.append((a, b))
        return in_constant_time(a, b)

    monkeypatch.setattr(tokens.hmac, "compare_digest", compare)
    both = TokenKeys((KEYS.secrets[0], b"an older secret of 32 characters"))
    assert both.access(TOKEN, "studio", unix_seconds=NOW) is Access.GRANTED
    assert len(compared) == 2  # each secret, also after the right one


def test_a_secret_is_replaced_while_its_tokens_are_about(tmp_path: Path) -> None:
    file = tmp_path / "secret"
    file.write_bytes(b"\n a new secret of thirty-two characters \n" + KEYS.secrets[0] + b"\r\n")
    both = read_keys(file)
    assert both.access(TOKEN, "studio", unix_seconds=NOW) is Access.GRANTED
    newer = both.token("studio", expires_unix_seconds=int(NOW) + 60)
    assert KEYS.access(newer, "studio", unix_seconds=NOW) is Access.FORGED


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "cannot be read"),
        (b"", "is empty"),
        (b" \n\n", "is empty"),
        (b"short\n", "has 5 characters, and at least 32 are needed"),
        (b"x" * 40 + b"\nshort\n", "has 5 characters"),
    ],
)
def test_secrets_that_are_refused(tmp_path: Path, content: bytes | None, words: str) -> None:
    file = tmp_path / "secret"
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(ConfigError, match=words):
        read_keys(file)


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Served]:
    GrowingFolder(tmp_path / "studio", STREAM).write_all()
    (tmp_path / "ball.sgs").write_bytes(STREAM)
    settings = ServerSettings(tmp_path, keys=KEYS)
    with hosted(settings, clock=lambda: NOW) as running:
        yield running


def everything(tmp_path: Path) -> list[str]:
    files = [f"/streams/studio/{file.name}" for file in (tmp_path / "studio").iterdir()]
    return [*files, "/streams/studio/", "/streams/studio/preview"]


def test_nothing_is_shown_without_a_token(server: Served, tmp_path: Path) -> None:
    missing, forged = b"An access token is needed here.", b"The access token is not one of this server."
    queries = {"": missing, "?token=": missing, "?token=v1.9999999999.x.studio": forged, f"?token={TOKEN[:-1]}": forged}
    for address in (*everything(tmp_path), "/", "/streams.json", "/metrics", "/streams/nobody/", "/streams/nobody/x"):
        for query, words in queries.items():
            answer = server.ask(address + query)
            assert (answer.status, answer.body) == (401, words), address
            assert answer.headers["www-authenticate"].startswith("Bearer")
            assert answer.headers["cache-control"] == "no-store"
    assert server.ask("/health").status == 200
    assert server.ask("/player.js").status == 200


def test_a_token_in_the_query_or_the_header(server: Served, tmp_path: Path) -> None:
    for address in everything(tmp_path):
        expected = 404 if address.endswith("preview") else 200
        assert server.ask(f"{address}?token={TOKEN}").status == expected
        assert server.ask(address, Authorization=f"Bearer {TOKEN}").status == expected
        assert server.ask(f"{address}?token={TOKEN}", Authorization="Bearer forged").status == 401
        assert server.ask(address, Authorization=f"Basic {TOKEN}").status == 401


def test_the_header_comes_before_the_query() -> None:
    def found(authorization: str) -> str | None:
        headers = [(b"authorization", authorization.encode())]
        return token_of(Request({"type": "http", "headers": headers, "query_string": b"token=one"}))

    assert found("Bearer two.~+/-_==") == "two.~+/-_=="
    assert found("bEARER   two") == "two"
    for other in ("Basic two", "Bearer", "Bearer two three", "Bearer two\n", "Bearer =", "Bearertwo"):
        assert found(other) == "one", other


def test_a_token_of_another_stream_and_one_that_expired(server: Served, tmp_path: Path) -> None:
    other = KEYS.token("ball.sgs", expires_unix_seconds=int(NOW) + 60)
    old = KEYS.token("studio", expires_unix_seconds=int(NOW))
    for address in everything(tmp_path):
        refused = server.ask(f"{address}?token={other}")
        assert (refused.status, refused.body) == (403, b"The access token is for another stream.")
        expired = server.ask(f"{address}?token={old}")
        assert (expired.status, expired.body) == (401, b"The access token has expired.")
    # It does not say which streams there are, either.
    assert server.ask(f"/streams/nobody/?token={other}").status == 403
    assert server.ask(f"/metrics?token={TOKEN}").status == 403


def test_the_list_shows_what_the_token_opens_and_passes_it_on(server: Served) -> None:
    page = server.ask(f"/?token={TOKEN}").text
    assert f'href="streams/studio/?token={TOKEN}"' in page
    assert f"streams/studio/preview?token={TOKEN}&quot;" in page
    assert "ball" not in page
    every = KEYS.token(EVERY_STREAM, expires_unix_seconds=int(NOW) + 60)
    names = [one["name"] for one in server.ask(f"/streams.json?token={every}").json["streams"]]
    assert names == ["ball.sgs", "studio"]
    assert server.ask("/metrics", Authorization=f"Bearer {every}").status == 200


def test_the_page_passes_its_token_on(server: Served) -> None:
    page = server.ask(f"/streams/studio/?token={TOKEN}&x=<b>")
    assert f'src="manifest.json?token={TOKEN}"' in page.text
    assert "<b>" not in page.text
    assert page.headers["referrer-policy"] == "no-referrer"
    assert page.headers["cache-control"] == "no-store"


def test_caches_on_the_way_keep_nothing(server: Served, tmp_path: Path) -> None:
    for file in (tmp_path / "studio").iterdir():
        kept = server.ask(f"/streams/studio/{file.name}?token={TOKEN}").headers["cache-control"]
        assert kept.startswith("private")

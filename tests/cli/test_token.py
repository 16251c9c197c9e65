# SPDX-License-Identifier: Apache-2.0
"""The command ``token``."""

from pathlib import Path

import pytest

from structgstream.cli import main, serve
from structgstream.serve.access import Access, read_keys
from tests.support.quick_streams import error_of

NOW = 1.7e9


@pytest.fixture
def secret(tmp_path: Path) -> Path:
    (tmp_path / "secret").write_text("a secret of thirty-two characters\n")
    return tmp_path / "secret"


@pytest.fixture(autouse=True)
def still(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serve.time, "time", lambda: NOW)


def printed(secret: Path, capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert main(["token", "--secret-file", str(secret), *arguments]) == 0
    return capsys.readouterr().out.removesuffix("\n")


def test_a_token_holds_for_its_hours(secret: Path, capsys: pytest.CaptureFixture[str]) -> None:
    keys = read_keys(secret)
    made = printed(secret, capsys, "studio", "--hours", "1.5")
    assert keys.access(made, "studio", unix_seconds=NOW + 5399) is Access.GRANTED
    assert keys.access(made, "studio", unix_seconds=NOW + 5400) is Access.EXPIRED
    assert keys.access(made, "other", unix_seconds=NOW) is Access.OTHER_STREAM
    made = printed(secret, capsys, "studio")
    assert keys.access(made, "studio", unix_seconds=NOW + 7199) is Access.GRANTED
    assert keys.access(made, "studio", unix_seconds=NOW + 7200) is Access.EXPIRED


@pytest.mark.parametrize("address", ["https://x.example", "https://x.example/", "https://x.example//"])
def test_links(secret: Path, address: str, capsys: pytest.CaptureFixture[str]) -> None:
    one = printed(secret, capsys, "studio", "--address", address)
    assert one == f"https://x.example/streams/studio/?token={printed(secret, capsys, 'studio')}"
    every = printed(secret, capsys, "--every", "--address", address)
    assert every == f"https://x.example/?token={printed(secret, capsys, '--every')}"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "name one stream, or say --every"),
        (["studio", "--every"], "name one stream, or say --every"),
        (["studio", "--hours", "0"], "--hours 0 is not above 0"),
        (["studio", "--hours", "nan"], "--hours nan is not above 0"),
        (["studio", "--hours", "1e9"], "a year"),
        (["../studio"], "is no name of a stream"),
    ],
)
def test_tokens_that_are_refused(
    secret: Path, arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert words in error_of(["token", *arguments, "--secret-file", str(secret)], capsys, status=2)

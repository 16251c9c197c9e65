# SPDX-License-Identifier: Apache-2.0
"""The commands ``serve`` and ``token``."""

import os
import signal
import subprocess
import sys
import urllib.error
import urllib.request
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

from structgstream.cli import main
from tests.support.quick_streams import error_of
from tests.support.running_commands import RunningCommand, running_command
from tests.support.segment_folders import GrowingFolder
from tests.support.streams import small_stream

STREAM = small_stream()
SECRET = "a secret of thirty-two characters\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    GrowingFolder(tmp_path / "streams" / "studio", STREAM).write_all()
    (tmp_path / "secret").write_text(SECRET)
    return tmp_path / "streams"


def serving(folder: Path, *arguments: str) -> AbstractContextManager[RunningCommand]:
    return running_command(folder.parent, "serve", str(folder), "--port", "0", *arguments)


def status(address: str) -> int:
    try:
        with urllib.request.urlopen(address, timeout=20) as response:
            return response.status
    except urllib.error.HTTPError as error:
        return error.code


def output_of(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    capsys.readouterr()
    assert main(arguments) == 0
    return capsys.readouterr().out


def test_it_serves_until_ctrl_c(folder: Path) -> None:
    with serving(folder) as command:
        assert status(f"{command.address()}streams/studio/manifest.json") == 200
        assert command.ended_by(signal.SIGINT) == 0
    lines = command.printed.read_text().splitlines()
    assert len(lines) == 1
    assert lines[0].startswith(f"The streams of {folder} are at http://127.0.0.1:")


def test_a_token_opens_what_a_secret_guards_until_sigterm(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    secret = ["--secret-file", str(folder.parent / "secret")]
    token = output_of(["token", "studio", *secret], capsys).strip()
    short = output_of(["token", "studio", "--hours", "0.0000001", *secret], capsys).strip()
    every = output_of(["token", "--every", *secret], capsys).strip()
    with serving(folder, *secret) as command:
        address = command.address()
        link = output_of(["token", "studio", *secret, "--address", address], capsys).strip()
        assert link.startswith(f"{address}streams/studio/?token=v1.")
        assert status(link) == 200
        for text, expected in ((token, 200), (every, 200), (short, 401), ("", 401)):
            assert status(f"{address}streams/studio/manifest.json?token={text}") == expected
        assert status(f"{address}?token={every}") == 200
        assert command.ended_by(signal.SIGTERM) == -signal.SIGTERM
    assert "Viewers need a token" in command.printed.read_text()


@pytest.mark.parametrize(
    ("arguments", "expected", "words"),
    [
        (["--host", "0.0.0.0"], 2, "give --secret-file"),
        (["--host", "example.org"], 2, "is no IP address"),
        (["--port", "70000"], 2, "--port 70000 is not one of 0 to 65535"),
        (["--allow-origin", "example.org"], 2, "is no origin"),
        (["--proxy", "everyone"], 2, "is no IP address or network"),
        (["--connections", "0"], 2, "--connections 0 is not one of 1 to 100000"),
        (["--secret-file", "/no/such/file"], 2, "openssl rand -hex 32"),
        (["--host", "192.0.2.1", "--public"], 1, "cannot be used"),
    ],
)
def test_what_is_refused(
    folder: Path, arguments: list[str], expected: int, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    error = error_of(["serve", str(folder), *arguments], capsys, status=expected)
    assert words in error
    assert len(error.strip().splitlines()) == 1


def test_what_is_no_folder_of_streams(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "cannot be read" in error_of(["serve", str(folder / "none")], capsys, status=1)
    file = folder / "studio" / "manifest.json"
    assert "is a file; serve takes a folder" in error_of(["serve", str(file)], capsys, status=1)


def test_a_missing_extra_is_reported(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in [name for name in sys.modules if name.startswith("structgstream.serve")]:
        monkeypatch.delitem(sys.modules, name)
    for name in [name for name in sys.modules if name.split(".")[0] == "uvicorn"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "uvicorn", None)  # type: ignore[arg-type]
    assert "pip install 'structgstream[serve]'" in error_of(["serve", str(folder)], capsys, status=1)


def test_the_server_needs_no_torch(folder: Path) -> None:
    code = (
        "import sys; import structgstream.serve.listening; print(*{'torch', 'numpy', 'av', 'cv2'} & set(sys.modules))"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=os.environ)
    assert found.stdout.split() == []

# SPDX-License-Identifier: Apache-2.0
"""The commands ``serve`` and ``token``."""

import http.client
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from structgstream.cli import main
from tests.support.segment_folders import GrowingFolder
from tests.support.streams import small_stream

STREAM = small_stream()
SECRET = "a secret of thirty-two characters\n"
PATIENCE_SECONDS = 60.0
COMMAND = """
import runpy, signal
signal.signal(signal.SIGINT, signal.default_int_handler)
runpy.run_module("structgstream", run_name="__main__", alter_sys=True)
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    GrowingFolder(tmp_path / "streams" / "studio", STREAM).write_all()
    (tmp_path / "secret").write_text(SECRET)
    return tmp_path / "streams"


@contextmanager
def serving(folder: Path, *arguments: str) -> Iterator[tuple["subprocess.Popen[bytes]", int]]:
    """The command in a process of its own, and its port."""
    printed = folder.parent / "printed"
    with printed.open("wb") as output:
        command = [sys.executable, "-c", COMMAND, "serve", str(folder), "--port", "0", *arguments]
        process = subprocess.Popen(command, stdout=output, stderr=output)
    try:
        last = time.monotonic() + PATIENCE_SECONDS
        while not (found := re.search(r"http://127\.0\.0\.1:(\d+)/", printed.read_text())):
            assert time.monotonic() < last, printed.read_text()
            time.sleep(0.1)
        yield process, int(found[1])
    finally:
        process.kill()
        process.wait()


def status(port: int, path: str) -> int:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    connection.request("GET", path)
    found = connection.getresponse().status
    connection.close()
    return found


def output_of(arguments: list[str], capsys: pytest.CaptureFixture[str], *, expected: int = 0) -> str:
    capsys.readouterr()
    assert main(arguments) == expected
    captured = capsys.readouterr()
    return captured.err if expected else captured.out


def test_it_serves_until_ctrl_c(folder: Path) -> None:
    with serving(folder) as (process, port):
        assert status(port, "/streams/studio/manifest.json") == 200
        process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE_SECONDS) == 0
    lines = (folder.parent / "printed").read_text().splitlines()
    assert len(lines) == 1
    assert lines[0].startswith(f"The streams of {folder} are at http://127.0.0.1:")


def test_a_token_opens_what_a_secret_guards_until_sigterm(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    secret = ["--secret-file", str(folder.parent / "secret")]
    token = output_of(["token", "studio", *secret], capsys).strip()
    short = output_of(["token", "studio", "--hours", "0.0000001", *secret], capsys).strip()
    every = output_of(["token", "--every", *secret], capsys).strip()
    with serving(folder, *secret) as (process, port):
        link = output_of(["token", "studio", *secret, "--address", f"http://127.0.0.1:{port}"], capsys).strip()
        assert link.startswith(f"http://127.0.0.1:{port}/streams/studio/?token=v1.")
        assert status(port, link.removeprefix(f"http://127.0.0.1:{port}")) == 200
        manifest = "/streams/studio/manifest.json"
        for text, expected in ((token, 200), (every, 200), (short, 401), ("", 401)):
            assert status(port, f"{manifest}?token={text}") == expected
        assert status(port, f"/?token={every}") == 200
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE_SECONDS) == -signal.SIGTERM
    assert "Viewers need a token" in (folder.parent / "printed").read_text()


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
    error = output_of(["serve", str(folder), *arguments], capsys, expected=expected)
    assert words in error
    assert len(error.strip().splitlines()) == 1


def test_what_is_no_folder_of_streams(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "cannot be read" in output_of(["serve", str(folder / "none")], capsys, expected=1)
    file = folder / "studio" / "manifest.json"
    assert "is a file; serve takes a folder" in output_of(["serve", str(file)], capsys, expected=1)


def test_a_missing_extra_is_reported(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in [name for name in sys.modules if name.startswith("structgstream.serve")]:
        monkeypatch.delitem(sys.modules, name)
    for name in [name for name in sys.modules if name.split(".")[0] == "uvicorn"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "uvicorn", None)  # type: ignore[arg-type]
    assert "pip install 'structgstream[serve]'" in output_of(["serve", str(folder)], capsys, expected=1)


def test_the_server_needs_no_torch(folder: Path) -> None:
    code = (
        "import sys; import structgstream.serve.listening; print(*{'torch', 'numpy', 'av', 'cv2'} & set(sys.modules))"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=os.environ)
    assert found.stdout.split() == []

# SPDX-License-Identifier: Apache-2.0
"""Commands that show streams: serve, play and token; they end on Ctrl-C, and say what is wrong in one line."""

import json
import os
import signal
import sys
import time
import urllib.error
import urllib.request
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

from structgstream.cli import serve
from structgstream.codec.sinks import FileSink
from structgstream.data.dataset_layouts import bundled_clip_path
from structgstream.serve.access import Access, read_keys
from tests.support.quick_streams import Runner
from tests.support.rigs import random_scene
from tests.support.running_commands import RunningCommand, running_command
from tests.support.segment_folders import GrowingFolder
from tests.support.streams import header_for, small_stream, write_stream

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


def test_it_serves_until_ctrl_c(folder: Path) -> None:
    with serving(folder) as command:
        assert status(f"{command.address()}streams/studio/manifest.json") == 200
        assert command.ended_by(signal.SIGINT) == 0
    lines = command.printed.read_text().splitlines()
    assert len(lines) == 1
    assert lines[0].startswith(f"The streams of {folder} are at http://127.0.0.1:")


def test_a_token_opens_what_a_secret_guards_until_sigterm(folder: Path, run: Runner) -> None:
    secret = ["--secret-file", str(folder.parent / "secret")]
    token = run(["token", "studio", *secret]).out.strip()
    short = run(["token", "studio", "--hours", "0.0000001", *secret]).out.strip()
    every = run(["token", "--every", *secret]).out.strip()
    with serving(folder, *secret) as command:
        address = command.address()
        link = run(["token", "studio", *secret, "--address", address]).out.strip()
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
def test_what_is_refused(folder: Path, arguments: list[str], expected: int, words: str, run: Runner) -> None:
    error = run(["serve", str(folder), *arguments], status=expected).err
    assert words in error
    assert len(error.strip().splitlines()) == 1


def test_what_is_no_folder_of_streams(folder: Path, run: Runner) -> None:
    assert "cannot be read" in run(["serve", str(folder / "none")], status=1).err
    file = folder / "studio" / "manifest.json"
    assert "is a file; serve takes a folder" in run(["serve", str(file)], status=1).err


def test_the_server_needs_only_what_its_image_installs(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """deploy/Dockerfile has the extra of the server, and neither torch nor numpy."""
    hidden = tmp_path / "hidden"
    hidden.mkdir()
    for name in ("torch", "numpy", "zstandard", "av", "cv2", "PIL", "scipy", "yaml"):
        (hidden / f"{name}.py").write_text("raise ModuleNotFoundError(name=__name__)")
    paths = [str(hidden), *filter(None, [os.environ.get("PYTHONPATH")])]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(paths))
    write_stream(FileSink(folder / "one.sgs"), [random_scene(5)])
    with serving(folder) as command:
        address = command.address()
        for page in ("", "health", "metrics", "streams/studio/", "streams/studio/manifest.json", "streams/one.sgs/"):
            assert status(f"{address}{page}") == 200, page
        assert fetched(f"{address}streams/one.sgs/stream.sgs") == (folder / "one.sgs").read_bytes()


def fetched(address: str) -> bytes:
    with urllib.request.urlopen(address, timeout=20) as response:
        return response.read()


def test_it_waits_for_the_file_and_its_whole_header_and_serves_until_ctrl_c(tmp_path: Path) -> None:
    file = tmp_path / "s.sgs"
    with running_command(tmp_path, "play", str(file), "--wait") as command:
        command.said("Waiting for")
        file.write_bytes(STREAM[:100])
        time.sleep(0.7)
        assert command.process.poll() is None
        file.write_bytes(STREAM[:-5])
        address = command.address()
        assert b"<structgstream-player" in fetched(address)
        assert fetched(f"{address}stream") == STREAM[:-5]
        file.write_bytes(STREAM)
        assert json.loads(fetched(f"{address}state")) == {"bytes": len(STREAM), "complete": True}
        assert command.ended_by(signal.SIGINT) == 0
        said = command.printed.read_text()
    assert "frames appear as they are written" in said
    assert "no screen to open a browser on" in said
    assert "Traceback" not in said


def test_ctrl_c_ends_waiting(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: Runner) -> None:
    def interrupted(seconds: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("structgstream.cli.serve.time.sleep", interrupted)
    error = run(["play", str(tmp_path / "never.sgs"), "--wait"], status=130).err
    assert "Waiting for" in error
    assert "Traceback" not in error


@pytest.mark.parametrize(
    ("content", "extra", "status", "words"),
    [
        (None, [], 1, "No such file"),
        (b"", [], 1, "is empty"),
        (b"hello, this is no stream", [], 1, "is not a structgstream file"),
        (STREAM[:200], [], 1, "cut at byte 200"),
        (STREAM, ["--port", "70000"], 2, "--port 70000 is not one of 0 to 65535"),
        (STREAM, ["--capture", "/no/such/folder"], 1, "does not exist"),
    ],
)
def test_what_cannot_be_played(
    tmp_path: Path, content: bytes | None, extra: list[str], status: int, words: str, run: Runner
) -> None:
    file = tmp_path / "s.sgs"
    if content is not None:
        file.write_bytes(content)
    assert words in run(["play", str(file), "--no-browser", *extra], status=status).err


def test_the_capture_of_another_stream_is_reported(tmp_path: Path, run: Runner) -> None:
    file = tmp_path / "s.sgs"
    scene = random_scene(5)
    write_stream(FileSink(file), [scene], header=header_for(scene))
    error = run(["play", str(file), "--no-browser", "--capture", str(bundled_clip_path())], status=1).err
    assert "of the capture clip" in error or "in the capture clip" in error


@pytest.mark.parametrize("missing", ["starlette", "uvicorn"])
@pytest.mark.parametrize("command", ["serve", "play"])
def test_a_missing_extra_is_reported(
    tmp_path: Path, command: str, missing: str, monkeypatch: pytest.MonkeyPatch, run: Runner
) -> None:
    for name in [name for name in sys.modules if name.startswith(("structgstream.serve", missing))]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, missing, None)  # type: ignore[arg-type]
    error = run([command, str(tmp_path / "s.sgs")], status=1).err
    assert "pip install 'structgstream[serve]'" in error


NOW = 1.7e9


@pytest.fixture
def secret(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file of secrets, where time stands still."""
    monkeypatch.setattr(serve.time, "time", lambda: NOW)
    (tmp_path / "secret").write_text(SECRET)
    return tmp_path / "secret"


def printed(secret: Path, run: Runner, *arguments: str) -> str:
    return run(["token", "--secret-file", str(secret), *arguments]).out.removesuffix("\n")


def test_a_token_holds_for_its_hours(secret: Path, run: Runner) -> None:
    keys = read_keys(secret)
    made = printed(secret, run, "studio", "--hours", "1.5")
    assert keys.access(made, "studio", unix_seconds=NOW + 5399) is Access.GRANTED
    assert keys.access(made, "studio", unix_seconds=NOW + 5400) is Access.EXPIRED
    assert keys.access(made, "other", unix_seconds=NOW) is Access.OTHER_STREAM
    made = printed(secret, run, "studio")
    assert keys.access(made, "studio", unix_seconds=NOW + 7199) is Access.GRANTED
    assert keys.access(made, "studio", unix_seconds=NOW + 7200) is Access.EXPIRED


@pytest.mark.parametrize("address", ["https://x.example", "https://x.example/", "https://x.example//"])
def test_links(secret: Path, address: str, run: Runner) -> None:
    one = printed(secret, run, "studio", "--address", address)
    assert one == f"https://x.example/streams/studio/?token={printed(secret, run, 'studio')}"
    every = printed(secret, run, "--every", "--address", address)
    assert every == f"https://x.example/?token={printed(secret, run, '--every')}"


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
def test_tokens_that_are_refused(secret: Path, arguments: list[str], words: str, run: Runner) -> None:
    assert words in run(["token", *arguments, "--secret-file", str(secret)], status=2).err

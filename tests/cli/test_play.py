# SPDX-License-Identifier: Apache-2.0
"""The command ``play``: it serves, follows, waits, ends on Ctrl-C, and says what is wrong in one line."""

import json
import signal
import sys
import time
import urllib.request
from pathlib import Path

import pytest

from structgstream.cli import main
from structgstream.codec.sinks import FileSink
from structgstream.data.dataset_layouts import bundled_clip_path
from tests.support.quick_streams import error_of
from tests.support.rigs import random_scene
from tests.support.running_commands import running_command
from tests.support.streams import header_for, small_stream, write_stream

STREAM = small_stream()


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


def test_ctrl_c_ends_waiting(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(seconds: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("structgstream.cli.serve.time.sleep", interrupted)
    assert main(["play", str(tmp_path / "never.sgs"), "--wait"]) == 130
    error = capsys.readouterr().err
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
    tmp_path: Path,
    content: bytes | None,
    extra: list[str],
    status: int,
    words: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    file = tmp_path / "s.sgs"
    if content is not None:
        file.write_bytes(content)
    assert words in error_of(["play", str(file), "--no-browser", *extra], capsys, status=status)


def test_the_capture_of_another_stream_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "s.sgs"
    scene = random_scene(5)
    write_stream(FileSink(file), [scene], header=header_for(scene))
    error = error_of(["play", str(file), "--no-browser", "--capture", str(bundled_clip_path())], capsys, status=1)
    assert "of the capture clip" in error or "in the capture clip" in error


@pytest.mark.parametrize("missing", ["starlette", "uvicorn"])
def test_a_missing_extra_is_reported(
    tmp_path: Path, missing: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in [name for name in sys.modules if name.startswith(("structgstream.serve", missing))]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, missing, None)  # type: ignore[arg-type]
    error = error_of(["play", str(tmp_path / "s.sgs")], capsys, status=1)
    assert "pip install 'structgstream[serve]'" in error

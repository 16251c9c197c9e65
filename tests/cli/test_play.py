# SPDX-License-Identifier: Apache-2.0
"""The command ``play``: it serves, follows, waits, ends on Ctrl-C, and says what is wrong in one line."""

import json
import os
import re
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

from structgstream.cli import main
from structgstream.codec.sinks import FileSink
from structgstream.data.dataset_layouts import bundled_clip_path
from tests.support.rigs import random_scene
from tests.support.streams import header_for, small_stream, write_stream

STREAM = small_stream()
PATIENCE_SECONDS = 60.0
# As `python -m structgstream`, with Ctrl-C as a terminal has it: whoever starts the tests in the background has it
# ignored, and children inherit that.
COMMAND = """
import runpy, signal
signal.signal(signal.SIGINT, signal.default_int_handler)
runpy.run_module("structgstream", run_name="__main__", alter_sys=True)
"""


@dataclass
class Playing:
    """The command in a process of its own, and the file that it prints into."""

    process: "subprocess.Popen[bytes]"
    printed: Path

    def said(self, pattern: str) -> str:
        """What matches ``pattern``, once it is printed."""
        last = time.monotonic() + PATIENCE_SECONDS
        while time.monotonic() < last:
            if found := re.search(pattern, self.printed.read_text()):
                return found[0]
            time.sleep(0.1)
        raise AssertionError(f"no {pattern} in {self.printed.read_text()!r}")

    def address(self) -> str:
        """The address that is announced."""
        return self.said(r"http://127\.0\.0\.1:\d+/")

    def interrupted(self) -> int:
        """Presses Ctrl-C; gives back the exit status."""
        self.process.send_signal(signal.SIGINT)
        return self.process.wait(PATIENCE_SECONDS)


@contextmanager
def playing(folder: Path, *arguments: str) -> Iterator[Playing]:
    """The command, on a machine without a screen."""
    environ = {name: text for name, text in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER")}
    printed = folder / "printed"
    with printed.open("wb") as output:
        process = subprocess.Popen(
            [sys.executable, "-c", COMMAND, "play", *arguments], stdout=output, stderr=output, env=environ
        )
    try:
        yield Playing(process, printed)
    finally:
        process.kill()
        process.wait()


def fetched(address: str) -> bytes:
    with urllib.request.urlopen(address, timeout=20) as response:
        return response.read()


def error_of(arguments: list[str], capsys: pytest.CaptureFixture[str], *, status: int) -> str:
    capsys.readouterr()
    assert main(["play", *arguments]) == status
    error = capsys.readouterr().err
    assert "Traceback" not in error
    assert len(error.strip().splitlines()) == 1
    return error


def test_it_waits_for_the_file_and_its_whole_header_and_serves_until_ctrl_c(tmp_path: Path) -> None:
    file = tmp_path / "s.sgs"
    with playing(tmp_path, str(file), "--wait") as command:
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
        assert command.interrupted() == 0
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
    assert words in error_of([str(file), "--no-browser", *extra], capsys, status=status)


def test_the_capture_of_another_stream_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "s.sgs"
    scene = random_scene(5)
    write_stream(FileSink(file), [scene], header=header_for(scene))
    error = error_of([str(file), "--no-browser", "--capture", str(bundled_clip_path())], capsys, status=1)
    assert "of the capture clip" in error or "in the capture clip" in error


@pytest.mark.parametrize("missing", ["starlette", "uvicorn"])
def test_a_missing_extra_is_reported(
    tmp_path: Path, missing: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in [name for name in sys.modules if name.startswith(("structgstream.serve", missing))]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, missing, None)  # type: ignore[arg-type]
    error = error_of([str(tmp_path / "s.sgs")], capsys, status=1)
    assert "pip install 'structgstream[serve]'" in error

# SPDX-License-Identifier: Apache-2.0
"""Dispatch, exit statuses, and one sentence for what goes wrong."""

import importlib.metadata
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
import torch

import structgstream
from structgstream.cli import app
from structgstream.cli.app import COMMANDS, main
from structgstream.errors import CaptureError, OutOfMemoryError
from tests.support.quick_streams import CLIP, Runner


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch):
    """Lets a test say what the command does."""

    def install(action) -> None:
        monkeypatch.setattr(app.importlib, "import_module", lambda name: SimpleNamespace(main=action))

    return install


def raising(error: BaseException):
    def action(arguments: list[str]) -> None:
        raise error

    return action


def test_help_names_every_command_and_has_examples(run: Runner) -> None:
    text = run(["--help"]).out
    assert all(f"\n  {name} " in text for name in COMMANDS)
    assert "examples:" in text


def test_nothing_given_is_wrong_usage(run: Runner) -> None:
    assert "usage: structgstream" in run([], status=2).err


def test_version(run: Runner) -> None:
    assert run(["--version"]).out.strip() == structgstream.__version__


def test_a_misspelt_command_is_named_with_the_nearest(run: Runner) -> None:
    assert "Did you mean 'evaluate'?" in run(["evalaute"], status=2).err


@pytest.mark.parametrize(
    ("error", "status", "said"),
    [
        (CaptureError("The capture x is an empty folder."), 1, "The capture x is an empty folder.\n"),
        (app.UsageError("there is no preset 'x'."), 2, "there is no preset 'x'.\n"),
        (OutOfMemoryError("to lift flow"), 1, "Not enough memory to lift flow; close other programs, or use smaller"),
        (MemoryError(), 1, "not enough memory; close other programs, or use smaller pictures (--scale 0.5)."),
        (MemoryError("Unable to allocate 3 TiB"), 1, "not enough memory (Unable to allocate 3 TiB); close other"),
        (torch.OutOfMemoryError("CUDA out of memory.\nGPU 0 has"), 1, "Not enough memory on the GPU; close other"),
        (PermissionError(13, "Permission denied", "room/cam05"), 1, "no permission for room/cam05; change its"),
        (OSError(28, "No space left on device", "out.sgs"), 1, "the disk of out.sgs is full (No space left on device)"),
        (OSError(28, "No space left on device"), 1, "the disk is full (No space left on device); make room"),
        (OSError(5, "Input/output error", "x"), 1, "unexpected error, OSError: [Errno 5] Input/output error: 'x'."),
        (PermissionError("a message"), 1, "unexpected error, PermissionError: a message."),
        (IndexError("7"), 1, "unexpected error, IndexError: 7. Run the command again with --debug"),
    ],
)
def test_what_goes_wrong_is_one_sentence_without_a_traceback(
    command, error: Exception, status: int, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    command(raising(error))
    assert main(["demo"]) == status
    reported = capsys.readouterr().err
    assert reported.startswith(f"structgstream: {said}")
    assert reported.count("\n") == 1
    assert main(["demo", "--debug"]) == status
    assert ("Traceback" in capsys.readouterr().err) == (status == 1)


@pytest.mark.parametrize("error", [KeyboardInterrupt(), app.Interrupted("Go on with --resume.")])
def test_ctrl_c_ends_cleanly(command, error: BaseException, run: Runner) -> None:
    command(raising(error))
    assert run(["reconstruct"], status=130).err.strip() == f"Interrupted. {error}".strip()


def test_every_command_has_help_with_an_example_and_no_torch(run: Runner) -> None:
    for name in COMMANDS:
        assert f"Example: structgstream {name}" in run([name, "--help"]).out
    code = f"import sys; from structgstream.cli import main; [main([name, '--help']) for name in {[*COMMANDS]}]; "
    code += "print([m for m in ('torch', 'numpy', 'av', 'cv2', 'matplotlib') if m in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.splitlines()[-1] == "[]"


def test_another_distribution_brings_commands(monkeypatch: pytest.MonkeyPatch, run: Runner) -> None:
    called: list[list[str]] = []
    package = ModuleType("brought")
    package.COMMANDS = {"count": "count the frames"}  # type: ignore[attr-defined]
    command = ModuleType("brought.count")
    command.main = called.append  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "brought", package)
    monkeypatch.setitem(sys.modules, "brought.count", command)
    point = importlib.metadata.EntryPoint("more", "brought", app.ENTRY_POINTS)
    monkeypatch.setattr(
        importlib.metadata, "entry_points", lambda *, group: [point] if group == app.ENTRY_POINTS else []
    )
    assert main(["count", "--all"]) == 0
    assert called == [["--all"]]
    assert "\n  count        count the frames\n" in run(["--help"]).out
    assert "Did you mean 'count'?" in run(["cuont"], status=2).err


def test_exit_status_of_the_program() -> None:
    command = [sys.executable, "-m", "structgstream", "inspect", "x.sgs", "--jsn", "y"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (result.returncode, result.stdout) == (2, "")
    assert "--json" in result.stderr


def test_paths_that_cannot_work_are_reported(stream: Path, tmp_path: Path, run: Runner) -> None:
    new = str(tmp_path / "new.sgs")
    assert "does not exist" in run(["reconstruct", str(tmp_path / "no"), "-o", new], status=1).err
    assert "is a folder" in run(["reconstruct", CLIP, "-o", str(tmp_path)], status=1).err
    assert "cannot be created" in run(["reconstruct", CLIP, "-o", str(stream / "x" / "y")], status=1).err
    assert str(tmp_path / "no") in run(["inspect", str(tmp_path / "no")], status=1).err
    (tmp_path / "text").write_text("hello, this is no stream at all")
    assert "text" in run(["evaluate", str(tmp_path / "text"), CLIP], status=1).err
    assert "demo writes no .sgs" in run(["demo", "--output", str(stream)], status=2).err

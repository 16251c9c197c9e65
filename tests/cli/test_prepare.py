# SPDX-License-Identifier: Apache-2.0
"""The command prepare, as a user types it."""

import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from structgstream.cli.app import main
from structgstream.preparation.calibration.board import Board
from structgstream.preparation.options import Distance, PrepareOptions
from structgstream.preparation.output_folder import mark_output
from tests.support.quick_preparation import quicken
from tests.support.quick_streams import error_of
from tests.support.rooms import write_room


def test_prepare_then_check_and_a_mistake(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    quicken(monkeypatch)
    write_room(tmp_path / "videos")
    out = tmp_path / "out"
    command = ["prepare", str(tmp_path / "videos"), "-o", str(out), "--synchronize", "none", "--held-out", "cam02"]
    assert main(command) == 0
    message = capsys.readouterr().out
    assert "calibrate    cameras.json: 5 cameras" in message
    assert "add cameras, or move them closer together. The check found no error; see the warnings." in " ".join(
        message.split()
    )
    file = out / "capture.json"
    content = json.loads(file.read_text())
    assert content["held_out"] == ["cam02"]
    for entry in content["cameras"].values():
        entry["viewmat"] = [[entry["viewmat"][j][i] for j in range(3)] + [0.1] for i in range(3)] + [[0, 0, 0, 1]]
    file.write_text(json.dumps(content))
    assert main(["prepare", "--check", str(out), "--report", str(tmp_path / "report")]) == 1
    assert (tmp_path / "report" / "index.html").is_file()
    assert "structgstream: " in capsys.readouterr().err


def test_wrong_usage(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["prepare", str(tmp_path)]) == 2
    assert "-o CAPTURE" in capsys.readouterr().err
    assert main(["prepare", str(tmp_path), "-o", str(tmp_path / "out"), "--size", "720p"]) == 2
    assert "WIDTHxHEIGHT" in capsys.readouterr().err
    for ignored in (["-o", str(tmp_path / "out")], ["--lens", "brown"]):
        assert main(["prepare", "--check", str(tmp_path), *ignored]) == 2
        assert "it takes --report alone" in " ".join(capsys.readouterr().err.split())
    assert main(["prepare", str(tmp_path), "-o", str(tmp_path / "out"), "--report", str(tmp_path / "report")]) == 2
    assert "--report goes with --check" in capsys.readouterr().err
    assert main(["prepare", str(tmp_path / "nowhere"), "-o", str(tmp_path / "out")]) == 1
    assert "is missing; give the folder" in capsys.readouterr().err


def test_every_option_arrives(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[PrepareOptions] = []

    def note(videos: Path, capture: Path, *, options: PrepareOptions, listener: object) -> None:
        asked.append(options)
        raise KeyboardInterrupt

    monkeypatch.setattr("structgstream.preparation.prepare.prepare_capture", note)
    command = f"prepare {tmp_path} -o {tmp_path / 'out'} --calibration board --board 9x6:80mm --board-videos {tmp_path}"
    command += " --lens fisheye --intrinsics shared --refine --distance a b 3.2m --synchronize audio --near 0.2"
    command += " --field-of-view 90 --size 64x48 --held-out a b --fps 25 --without c --link copy"
    assert main(command.split()) == 130
    assert asked == [
        PrepareOptions(
            calibration="board", board=Board(9, 6, 0.08), board_videos=tmp_path, lens="fisheye", intrinsics="shared",
            refine=True, distance=Distance("a", "b", 3.2), synchronize="audio", near=0.2, field_of_view=90,
            size=(64, 48), held_out=("a", "b"), fps=25, without=("c",), link="copy",
        )
    ]  # fmt: skip


def hidden(path: Path) -> None:
    path.chmod(0)


def read_only(path: Path) -> None:
    path.chmod(0o555)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read and write everything")
@pytest.mark.parametrize(
    ("place", "change", "said"),
    [
        ("videos/cam02.mp4", hidden, "The video {place} cannot be opened (Permission denied); let yourself read it."),
        (
            "videos/cameras.json",
            hidden,
            "{place} cannot be read (Permission denied); expected width, height and cameras",
        ),
        ("videos", hidden, "no permission for {place}; change its permissions"),
        ("videos/masks", hidden, "no permission for {place}; change its permissions"),
        ("out", hidden, "no permission for {place}"),
        ("out", read_only, "The folder {place} cannot be written (Permission denied)."),
        ("out/work", read_only, "The folder {folder}/out cannot be written (Permission denied)."),
    ],
)
def test_what_may_not_be_read_or_written(
    tmp_path: Path, place: str, change: Callable[[Path], None], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """One sentence that names it, and nothing of the input is changed."""
    write_room(tmp_path / "videos")
    for folder in ("videos/masks", "out"):
        (tmp_path / folder).mkdir()
    if place == "out/work":
        mark_output(tmp_path / "out", tmp_path / "videos")
    before = {path: path.read_bytes() for path in (tmp_path / "videos").iterdir() if path.is_file()}
    path = tmp_path / place
    mode = path.stat().st_mode
    change(path)
    try:
        command = ["prepare", str(tmp_path / "videos"), "-o", str(tmp_path / "out"), "--synchronize", "none"]
        error = error_of(command, capsys, status=1)
    finally:
        path.chmod(mode)
    assert error.removeprefix("structgstream: ").startswith(said.format(place=path, folder=tmp_path))
    assert error.count("\n") == 1
    assert {path: path.read_bytes() for path in before} == before

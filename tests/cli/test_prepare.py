# SPDX-License-Identifier: Apache-2.0
"""The command prepare, as a user types it."""

import json
from pathlib import Path

import pytest

from rooms import write_room
from structgstream.cli.app import main
from structgstream.preparation.calibration.board import Board
from structgstream.preparation.options import Distance, PrepareOptions


def test_prepare_then_check_and_a_mistake(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_room(tmp_path / "videos")
    out = tmp_path / "out"
    command = ["prepare", str(tmp_path / "videos"), "-o", str(out), "--synchronize", "none", "--held-out", "cam02"]
    assert main(command) == 0
    told = capsys.readouterr().out
    assert "calibrate    cameras.json: 5 cameras" in told
    assert "found nothing that would spoil a stream" in told
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
    assert main(["prepare", "--check", str(tmp_path), "-o", str(tmp_path / "out")]) == 2
    capsys.readouterr()
    assert main(["prepare", str(tmp_path / "nowhere"), "-o", str(tmp_path / "out")]) == 1
    assert "is missing; give the folder" in capsys.readouterr().err


def test_every_option_arrives(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[PrepareOptions] = []

    def note(videos: Path, capture: Path, *, options: PrepareOptions, listener: object) -> None:
        asked.append(options)
        raise KeyboardInterrupt

    monkeypatch.setattr("structgstream.preparation.prepare.prepare_capture", note)
    command = f"prepare {tmp_path} -o {tmp_path / 'out'} --calibration board --board 9x6:80mm --board-videos {tmp_path}"
    command += " --lens fisheye --intrinsics shared --refine --tone --distance a b 3.2m --synchronize audio --near 0.2"
    command += " --field-of-view 90 --size 64x48 --held-out a b --fps 25 --without c --link copy"
    assert main(command.split()) == 130
    assert asked == [
        PrepareOptions(
            calibration="board", board=Board(9, 6, 0.08), board_videos=tmp_path, lens="fisheye", intrinsics="shared",
            refine=True, tone=True, distance=Distance("a", "b", 3.2), synchronize="audio", near=0.2, field_of_view=90,
            size=(64, 48), held_out=("a", "b"), fps=25, without=("c",), link="copy",
        )
    ]  # fmt: skip
